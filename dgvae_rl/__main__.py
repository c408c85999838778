"""The command `dgvae`, as `python -m dgvae_rl`."""

from dgvae_rl.command import main

if __name__ == "__main__":
    main()
