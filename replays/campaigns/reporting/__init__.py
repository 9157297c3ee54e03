"""What is handed in of a campaign: results, page, pictures."""
