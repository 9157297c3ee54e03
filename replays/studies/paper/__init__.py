"""The paper's figures, tables and claims, made again by the rig and judged by number."""
