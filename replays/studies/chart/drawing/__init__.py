"""Pictures of a chart."""
