"""What holds a slot for a spare. It imports nothing: it starts beside a render server that viewers wait for."""


class SlotHolder:
    """Holds a render slot for a spare that has become a room's actor; ends with its keeper."""
