"""Virtual sensors: conversion of the model's observed rows to ADC counts, a pure function of rows and seed."""
