"""What a command says on standard error."""


def is_next_alone(text: str) -> bool:
    """Whether it is one line, the command that usually follows, and nothing else."""
    programs = tuple(f"next: {name} " for name in ("autotune", "cc", "ros2", "colcon"))
    return text.startswith(programs) and text.count("\n") == 1 and text.endswith("\n")
