"""Files at the border: pydantic documents, limits on reading, and messages about their faults."""
