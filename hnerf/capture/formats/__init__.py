"""Adapters, one for each layout on disk; nothing beyond `hnerf.capture.ingest` knows about formats."""
