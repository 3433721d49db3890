"""The commands of scans."""
