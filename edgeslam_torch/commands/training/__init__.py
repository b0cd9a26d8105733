"""Training commands: `finetune`, `distil`."""
