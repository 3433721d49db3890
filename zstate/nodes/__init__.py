"""Nodes: publishers, static publishers and clocks that programs open on a session."""
