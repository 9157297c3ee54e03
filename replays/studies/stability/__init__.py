"""Where methods fail: trials of every engine with the verdict that theory expects, and maps of where they hold."""

from __future__ import annotations
