"""Maps of the steps and stiffnesses at which engines hold and fail."""
