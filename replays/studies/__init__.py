"""Studies of methods: accuracy and speed, stability, model levels, contact laws, reproduction of the paper."""
