"""Functions of a C library as methods of CPython, which `firmware_py.compiling.bound_in` binds to memory.

A method takes nothing: its `self` has the addresses of what the function takes.
"""

KERNEL = "method"  # in the library of a kernel
METHOD = "method_"  # of an entry point of the core, before its name
PROTOTYPES = "char *PyBytes_AsString(void *object);\nvoid *PyLong_FromLongLong(long long value);\n"


def method(name: str, function: str, arguments: int, answers: bool) -> str:
    """Return the C of a method that calls a function with so many addresses; without an answer it returns 0."""
    places = ", ".join(f"places[{index}]" for index in range(arguments))
    call = f"{function}({places})"
    before, result = ("", call) if answers else (f"    {call};\n", "0")
    return (
        f"\nvoid *{name}(void *self, void *unused);\n\n"
        f"void *{name}(void *self, void *unused) {{\n"
        f"    void **places = (void **)PyBytes_AsString(self);\n    (void)unused;\n"
        f"{before}    return PyLong_FromLongLong({result});\n}}\n"
    )
