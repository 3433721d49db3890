"""Nodes: the objects that publish and listen."""
