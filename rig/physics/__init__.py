"""Physical model: parameters, laws, kernels and integration engines."""

from rig.physics.kernel_cache import choose_folder

choose_folder()
