"""Pages that turn shapes and play episodes in a browser, without a simulator; ``web/`` shows what is packed here."""
