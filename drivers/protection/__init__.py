"""Machinery protection monitor for one pair of probes and the keyphasor, which trips the rig."""

from drivers.protection.monitor import Action, Protection
from drivers.protection.settings import Settings

__all__ = ["Action", "Protection", "Settings"]
