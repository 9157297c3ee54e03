"""Import of other systems' logs to recordings of this rig, and export of recordings to other formats.

`conversion` makes a recording from `source` files and a `mapping`; `exporting.selection` provides what the
`FormatWriter` of a format writes. Each module of `readers` (`mdf`, `tdms`, `uff`, `delimited`, `columnar`, `wav`) reads
and writes one format.
"""
