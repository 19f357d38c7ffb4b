"""The benchmark kit: turns, targets, tables, plots and records of operators and whole models."""
