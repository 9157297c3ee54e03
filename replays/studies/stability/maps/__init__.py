"""Maps of where engines hold and fail."""
