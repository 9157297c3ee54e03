"""Serving a run: pace, requests, devices, transport."""
