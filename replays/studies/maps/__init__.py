"""Maps of the outcome, or a quantity, of runs over two keys of a scene, refined where the outcome changes."""
