"""Evaluation commands: `eval`, `bench`, `ablation`, `judge`."""
