"""The rotary motors."""
