"""The scorecard: its rows and limits."""
