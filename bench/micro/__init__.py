"""One operation at a time, in one process."""
