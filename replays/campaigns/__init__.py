"""Campaigns: scripted tests of a device in the loop, run as pytest tests and written in Python or in TOML.

pytest loads `plugin`. `files.campaign` reads `*.campaign.toml`; `reporting` writes the results and their page.
"""
