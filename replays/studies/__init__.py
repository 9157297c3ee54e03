"""Studies of the methods: accuracy against speed, stability, model levels, laws, and the paper made again."""
