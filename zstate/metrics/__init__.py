"""Prometheus metrics: collectors that read existing counters at a scrape, and their HTTP endpoint."""
