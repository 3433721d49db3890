"""Ingest: received messages into a transform buffer."""
