"""Tasks for a kernel under test."""


def start(kernel, **tasks):
    """Create tasks, each (priority, function, *arguments) by its name, and start the kernel."""
    for name, (priority, function, *arguments) in tasks.items():
        kernel.create_task(name, priority, function, *arguments)
    kernel.start()
