"""What the subcommands of ``rawaug`` do, one file a command."""
