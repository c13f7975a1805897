"""What several networks share: diffusion, transformer blocks, training, files."""
