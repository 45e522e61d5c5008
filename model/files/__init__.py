"""File formats: pydantic documents, limits on reading, and messages about problems."""
