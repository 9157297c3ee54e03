"""Maps of the steps and stiffnesses at which engines are stable."""
