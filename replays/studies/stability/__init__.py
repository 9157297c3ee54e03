"""Stability of methods: trials of every engine against theory, and maps of stable steps."""

from __future__ import annotations
