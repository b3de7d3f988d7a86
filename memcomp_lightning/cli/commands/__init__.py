"""What the commands do; ``cli.entry`` starts them."""
