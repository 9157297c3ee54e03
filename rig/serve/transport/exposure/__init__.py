"""Certificates and permissions of a rig that is exposed to other hosts."""
