"""The model: kernels, engines, laws, parameters."""
