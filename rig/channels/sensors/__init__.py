"""Virtual sensors: from the model's observed rows to ADC counts, a pure function of the rows and the seed."""
