"""Mathematics without a library that takes long to load: roots, and expressions that a user writes."""
