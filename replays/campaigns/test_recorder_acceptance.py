"""Recorder acceptance: what a recorder leaves that is killed, or whose disk is full. Put your own command in its place."""

import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from recorder.reader import Recording

RECORD = f"{shlex.quote(sys.executable)} -m rig record --connect {{url}} -o {{folder}}/daq.mcap"
