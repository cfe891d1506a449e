"""Functions of a C library as methods of CPython, which `firmware_py.compiling.bound_in` binds to memory.

The `self` of a method has the addresses of the memory that the function takes; integers follow as its arguments.
"""

METHOD = "method_"  # before the name of a kernel or of an entry point of the core
PROTOTYPES = """\
char *PyBytes_AsString(void *object);
void *PyLong_FromLongLong(long long value);
long long PyLong_AsLongLong(void *object);
void *PyErr_Occurred(void);
void *PyObject_CallNoArgs(void *callable);
void Py_DecRef(void *object);
extern char _Py_NoneStruct;
int PyErr_BadArgument(void);
"""


def method(
    name: str, function: str, memory: int, answers: bool, numbers: int = 0, raises: bool = False
) -> str:
    """Return the C of a method that calls a function with addresses and integers; without an answer it returns 0.

    `raises`: the function may call Python.
    """
    taken = [f"places[{index}]" for index in range(memory)] + [f"given_{index}" for index in range(numbers)]
    call = f"{function}({', '.join(taken)})"
    check = "if (PyErr_Occurred()) return 0;"
    read = [f"const int64_t given_{index} = PyLong_AsLongLong(given[{index}]);" for index in range(numbers)]
    lines = [
        "void **places = (void **)PyBytes_AsString(self);",
        f"if (count != {numbers}) return PyErr_BadArgument(), (void *)0;",
        *([*read, check] if numbers else ["(void)given;"]),
        f"const int64_t answer = {call};" if answers else f"{call};",
        *([check] if raises else []),
        f"return PyLong_FromLongLong({'answer' if answers else '0'});",
    ]
    head = f"void *{name}(void *self, void *const *given, intptr_t count)"
    body = "".join(f"    {line}\n" for line in lines)
    return f"\n{head};\n\n{head} {{\n{body}}}\n"
