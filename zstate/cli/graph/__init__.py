"""zstate graph: who writes and reads what."""
