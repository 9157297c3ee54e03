"""Reports of a campaign: results, page, pictures."""
