"""Commands for routers, their access control, and certificates."""
