"""Playing, measuring and plotting trained policies."""
