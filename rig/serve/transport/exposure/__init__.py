"""Certificates and permissions of an exposed rig."""
