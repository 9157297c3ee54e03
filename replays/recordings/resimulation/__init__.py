"""The experiment of a recording done again, and how its signals change with any number of it."""
