"""Credentials, access control and the reasons why a router refuses."""
