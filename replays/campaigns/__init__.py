"""Campaigns: scripted tests of a device in the loop, as ordinary tests of pytest, written in Python or in TOML.

`plugin` is what pytest loads; `campaign` reads `*.campaign.toml`; `results` and `page` are what is handed in.
"""
