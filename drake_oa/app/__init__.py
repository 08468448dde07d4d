"""The command `drake-oa`."""
