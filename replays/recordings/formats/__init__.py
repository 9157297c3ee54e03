"""Other laboratories' file formats: their logs into recordings of this rig, and recordings into theirs.

`conversion` makes a recording out of `source` files by a `mapping`; `selection` gives what the `FormatWriter` of a
format writes. A module a format (`mdf`, `tdms`, `uff`, `delimited`, `columnar`, `wav`) both reads and writes it.
"""
