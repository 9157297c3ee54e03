"""The ladder of models: what each level of the model costs and errs by, and the cheapest that is good enough.

`measurement` runs one candidate, `quantity` says what is read off a run, `search` goes down the ladder, `chart` draws
it, `pick` writes what was found into a scene's file.
"""
