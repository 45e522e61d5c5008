"""From a verified plan to checked set-points."""
