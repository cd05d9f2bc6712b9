"""One adapter per layout on disk; nothing past `hnerf.capture.ingest` knows about formats."""
