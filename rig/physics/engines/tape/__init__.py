"""The equations of motion as a tape, and the code that is made of it. Nothing here takes part in a run."""
