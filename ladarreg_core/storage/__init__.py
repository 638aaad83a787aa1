"""Files written whole or not at all: replacement, staging, locks, checksums and manifests."""
