"""Campaigns written in TOML: the file, its cases, and what it expects."""
