"""Completed views that a scene brings: how they lie over their photographs, and their colours."""
