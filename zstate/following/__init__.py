"""What the messages of one robot become in a buffer."""
