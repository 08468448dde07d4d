"""What every layer uses: messages between systems, ports, configuration checks, files."""
