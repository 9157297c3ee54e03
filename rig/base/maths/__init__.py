"""Mathematics without slow imports: roots, and expressions written by users."""
