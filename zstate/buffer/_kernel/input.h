/* Numbers and buffers from Python, checked on entry. */

/* The stamp in an exact int of 64 bits. False, without an error, for anything else: the reference
 * then accepts it or raises the error. */
static bool
plain_stamp(PyObject *number, int64_t *stamp)
{
    int overflow = 0;
    if (!PyLong_CheckExact(number))
        return false;
    *stamp = PyLong_AsLongLongAndOverflow(number, &overflow);
    return overflow == 0;
}

/* A stamp, or TypeError or OverflowError. */
static bool
checked_stamp(PyObject *number, int64_t *stamp)
{
    *stamp = PyLong_AsLongLong(number);
    return *stamp != -1 || !PyErr_Occurred();
}

/* A C-contiguous buffer of 8-byte items of one of these formats. -1 and BufferError, TypeError or
 * ValueError when it is none. */
static int
get_items(PyObject *object, Py_buffer *view, const char *formats, int flags)
{
    if (PyObject_GetBuffer(object, view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | flags) < 0)
        return -1;
    const char *format = view->format != NULL ? view->format : "B";
    bool is_aligned = (uintptr_t)view->buf % 8 == 0 || view->len == 0;
    if (view->itemsize == 8 && strlen(format) == 1 && strchr(formats, format[0]) != NULL &&
        is_aligned)
        return 0;
    PyErr_Format(PyExc_ValueError, "an aligned buffer of format %s is wanted, not '%s'", formats,
                 format);
    PyBuffer_Release(view);
    return -1;
}

static int
get_doubles(PyObject *object, Py_buffer *view, int flags)
{
    return get_items(object, view, "d", flags);
}

/* int64 is "l" where a C long has 64 bits and "q" elsewhere. */
static int
get_stamps(PyObject *object, Py_buffer *view)
{
    return get_items(object, view, sizeof(long) == 8 ? "lq" : "q", 0);
}

static Py_ssize_t
count_of(const Py_buffer *view)
{
    return view->len / 8;
}

static bool
all_finite(const double *numbers, Py_ssize_t count)
{
    /* x * 0 is 0 for finite x and NaN otherwise: no branch in the loop. */
    double sum = 0.0;
    for (Py_ssize_t i = 0; i < count; i++)
        sum += numbers[i] * 0.0;
    return sum == 0.0;
}

/* Whether the object is no more than its memory. The reference handles subclasses of numpy's array:
 * a masked one exports its memory, not its mask. Types are compared by name, so that numpy's
 * headers are not needed. */
static bool
plain_array(PyObject *object)
{
    const char *type = Py_TYPE(object)->tp_name;
    return strcmp(type, "numpy.ndarray") == 0 || PyMemoryView_Check(object) ||
           strcmp(type, "array.array") == 0;
}

/* `count` finite doubles in a flat array. False, without an error, for anything else. */
static bool
plain_numbers(PyObject *object, Py_buffer *view, Py_ssize_t count)
{
    if (!plain_array(object))
        return false;
    if (get_doubles(object, view, 0) < 0) {
        PyErr_Clear();
        return false;
    }
    if (view->ndim == 1 && count_of(view) == count && all_finite(view->buf, count))
        return true;
    PyBuffer_Release(view);
    return false;
}

/* The same in bytes, little-endian as on the wire; big-endian machines leave it to the reference.
 */
static bool
plain_block(PyObject *object, Py_buffer *view, Py_ssize_t count)
{
    if (!PY_LITTLE_ENDIAN || !PyBytes_CheckExact(object) || PyBytes_GET_SIZE(object) / 8 != count ||
        PyBytes_GET_SIZE(object) % 8 != 0 || PyObject_GetBuffer(object, view, PyBUF_SIMPLE) < 0)
        return false;
    if (all_finite(view->buf, count))
        return true;
    PyBuffer_Release(view);
    return false;
}
