/* TransformFields: the data of a Transform, for zstate/transform.py. */

typedef struct {
    PyObject_HEAD
    PyObject *target;
    PyObject *source;
    PyObject *stamp;
    PyObject *kind;
    double predicted_s;
    Pose pose;
} TransformFields;

static PyTypeObject TransformFields_type;
static PyObject *kind_static, *kind_exact, *kind_interpolated;

/* A new object of a class that derives from TransformFields, with all fields set. */
static PyObject *
fields_new(PyTypeObject *type, PyObject *target, PyObject *source, Pose pose, PyObject *stamp,
           PyObject *kind)
{
    TransformFields *fields = (TransformFields *)type->tp_alloc(type, 0);
    if (fields == NULL)
        return NULL;
    Py_INCREF(target);
    Py_INCREF(source);
    Py_INCREF(stamp);
    Py_INCREF(kind);
    fields->target = target;
    fields->source = source;
    fields->stamp = stamp;
    fields->kind = kind;
    fields->pose = pose;
    return (PyObject *)fields;
}

static void
fields_dealloc(TransformFields *self)
{
    Py_CLEAR(self->target);
    Py_CLEAR(self->source);
    Py_CLEAR(self->stamp);
    Py_CLEAR(self->kind);
    Py_TYPE(self)->tp_free(self);
}

/* `count` floats of a tuple. -1 and TypeError or ValueError when it is none. */
static int
read_doubles(PyObject *tuple, double *numbers, Py_ssize_t count)
{
    if (!PyTuple_Check(tuple) || PyTuple_GET_SIZE(tuple) != count) {
        PyErr_Format(PyExc_ValueError, "a tuple of %zd numbers is wanted", count);
        return -1;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        numbers[i] = PyFloat_AsDouble(PyTuple_GET_ITEM(tuple, i));
        if (numbers[i] == -1.0 && PyErr_Occurred())
            return -1;
    }
    return 0;
}

/* From (target, source, pose, stamp, kind, predicted_s=0.0). -1 and an exception for other
 * arguments. */
static int
fields_fill(TransformFields *self, PyObject *const *args, Py_ssize_t count)
{
    double n[7];
    if (count < 5 || count > 6) {
        PyErr_SetString(PyExc_TypeError,
                        "fields are target, source, pose, stamp, kind, predicted_s=0.0");
        return -1;
    }
    double predicted_s = count == 6 ? PyFloat_AsDouble(args[5]) : 0.0;
    if ((predicted_s == -1.0 && PyErr_Occurred()) || read_doubles(args[2], n, 7) < 0)
        return -1;
    if (self->target != NULL) {
        PyErr_SetString(PyExc_AttributeError, "fields are filled once");
        return -1;
    }
    Py_INCREF(args[0]);
    Py_INCREF(args[1]);
    Py_INCREF(args[3]);
    Py_INCREF(args[4]);
    self->target = args[0];
    self->source = args[1];
    self->stamp = args[3];
    self->kind = args[4];
    self->predicted_s = predicted_s;
    self->pose = (Pose){n[0], n[1], n[2], n[3], n[4], n[5], n[6]};
    return 0;
}

static PyObject *
fields_trusted(PyObject *type, PyObject *const *args, Py_ssize_t count)
{
    PyObject *self = ((PyTypeObject *)type)->tp_alloc((PyTypeObject *)type, 0);
    if (self != NULL && fields_fill((TransformFields *)self, args, count) < 0)
        Py_CLEAR(self);
    return self;
}

static PyObject *
fields_fill_once(TransformFields *self, PyObject *const *args, Py_ssize_t count)
{
    if (fields_fill(self, args, count) < 0)
        return NULL;
    Py_RETURN_NONE;
}

static PyObject *
fields_pose(TransformFields *self, void *Py_UNUSED(closure))
{
    const Pose p = self->pose;
    if (self->target == NULL) {
        PyErr_SetString(PyExc_AttributeError, "_pose");
        return NULL;
    }
    return Py_BuildValue("(ddddddd)", p.x, p.y, p.z, p.qx, p.qy, p.qz, p.qw);
}

static PyMethodDef fields_methods[] = {
    {"trusted", (PyCFunction)(void (*)(void))fields_trusted, METH_FASTCALL | METH_CLASS,
     "trusted($type, target, source, pose, stamp, kind, predicted_s=0.0, /)\n--\n\n"
     "From seven floats that are known to be a pose: for the buffer, which checked at insert."},
    {"_fill", (PyCFunction)(void (*)(void))fields_fill_once, METH_FASTCALL,
     "As trusted, for constructors."},
    {NULL},
};

static PyMemberDef fields_members[] = {
    {"target", T_OBJECT_EX, offsetof(TransformFields, target), READONLY,
     "The frame that it is given in."},
    {"source", T_OBJECT_EX, offsetof(TransformFields, source), READONLY,
     "The frame whose pose it is."},
    {"stamp", T_OBJECT_EX, offsetof(TransformFields, stamp), READONLY,
     "Its instant [ns], or None."},
    {"kind", T_OBJECT_EX, offsetof(TransformFields, kind), READONLY, "How it was made."},
    {"predicted_s", T_DOUBLE, offsetof(TransformFields, predicted_s), READONLY,
     "How far ahead [s]."},
    {NULL},
};

static PyGetSetDef fields_getset[] = {
    {"_pose", (getter)fields_pose, NULL, "x y z qx qy qz qw.", NULL},
    {NULL},
};

static PyTypeObject TransformFields_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.TransformFields",
    .tp_doc = "The data of a Transform.",
    .tp_basicsize = sizeof(TransformFields),
    .tp_new = PyType_GenericNew,
    .tp_dealloc = (destructor)fields_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE,
    .tp_methods = fields_methods,
    .tp_members = fields_members,
    .tp_getset = fields_getset,
};
