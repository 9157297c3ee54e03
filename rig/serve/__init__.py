"""Serving of a run: pace, requests, devices, transport."""
