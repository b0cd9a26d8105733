"""The commands that judge: `eval`, `bench`, `ablation`, `judge`."""
