"""One module per command, each with ``add_arguments(parser)`` and ``main(args) -> int``.

`edgeslam_torch.cli` lists them; a module is imported only when its command is called.
"""
