"""Wire formats: messages, their encodings and their keys. Pure: no I/O."""
