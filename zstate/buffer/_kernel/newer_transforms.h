/* NewerTransforms: each newest transform of a path once, for zstate/buffer/waiting.py. */

typedef struct {
    PyObject_HEAD
    Path *path;
    int64_t version; /* of the tree, at which the path was current */
    int64_t stamp;   /* of the last transform */
} NewerTransforms;

static bool
has_newer(const NewerTransforms *self, int64_t *at)
{
    return track_count(self->path) > 0 && newest_common(self->path, at) && *at > self->stamp;
}

static PyObject *
newer_is_met(NewerTransforms *self, PyObject *Py_UNUSED(ignored))
{
    int64_t at;
    return PyBool_FromLong(has_newer(self, &at));
}

static PyObject *
newer_take(NewerTransforms *self, PyObject *number)
{
    int64_t version, at;
    if (!plain_stamp(number, &version) || version != self->version || !has_newer(self, &at))
        Py_RETURN_NONE;
    PyObject *transform = transform_when(self->path, at, NULL);
    if (transform != NULL && transform != Py_None)
        self->stamp = at;
    return transform;
}

static PyObject *
newer_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    static char *names[] = {"path", "version", "stamp", NULL};
    PyObject *path;
    long long version, stamp;
    if (!PyArg_ParseTupleAndKeywords(args, keywords, "O!LL:NewerTransforms", names, &Path_type,
                                     &path, &version, &stamp))
        return NULL;
    NewerTransforms *self = (NewerTransforms *)type->tp_alloc(type, 0);
    if (self == NULL)
        return NULL;
    Py_INCREF(path);
    self->path = (Path *)path;
    self->version = version;
    self->stamp = stamp;
    return (PyObject *)self;
}

static void
newer_dealloc(NewerTransforms *self)
{
    Py_XDECREF(self->path);
    Py_TYPE(self)->tp_free(self);
}

static PyMethodDef newer_methods[] = {
    {"is_met", (PyCFunction)newer_is_met, METH_NOARGS,
     "is_met(): whether all tracks have reached a newer instant than that of the last transform."},
    {"take", (PyCFunction)newer_take, METH_O,
     "take(version): the newest Transform, which is the last one from now on; None without a newer "
     "one, at another version of the tree, or if the reference has to be used."},
    {NULL},
};

static PyTypeObject NewerTransforms_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.NewerTransforms",
    .tp_doc = "Each newest transform of a path once.",
    .tp_basicsize = sizeof(NewerTransforms),
    .tp_new = newer_new,
    .tp_dealloc = (destructor)newer_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_methods = newer_methods,
};
