"""Physical model: parameters, laws, kernels and integration engines."""
