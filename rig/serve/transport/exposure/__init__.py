"""Who is who on a rig that is exposed, and who may say what."""
