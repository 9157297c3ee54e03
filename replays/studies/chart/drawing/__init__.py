"""The pictures of a chart."""
