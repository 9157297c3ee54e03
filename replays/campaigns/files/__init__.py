"""Campaign files in TOML: cases, steps and expectations."""
