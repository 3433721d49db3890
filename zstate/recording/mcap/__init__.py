"""The MCAP storage: files read, indexed, recovered and written without trust in their contents."""
