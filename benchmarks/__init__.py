"""Measurements of the whole project: `farside bench`, or `python -m benchmarks`, from a checkout.

harness    options, rows and their files, tables, intervals, the machine: shared by all studies
scenes     the views that are measured on, with their truth
measures   metrics, and the scores of one answer
rivals     the methods that are compared
studies    one file per study (see `harness.study`)
results    the rows of each study; docs/figures.md is made from them

Each room imports only itself and those above it in this list. `figures` and the command stand above all.
"""
