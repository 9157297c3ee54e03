"""What every part of the rig uses: units, errors, text, the wire's form, samples."""
