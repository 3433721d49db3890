/* A camera of v4l2 on a computer that has none: loaded by LD_PRELOAD, it is behind the path
   CAMERA_DEVICE.

   It sends what is in the file CAMERA_PICTURE, a JPEG or raw pixels as CAMERA_FORMAT says ("MJPG"
   or "YUYV"), of 64 x 48 or 32 x 24, 100 or 50 times a second. If that file is empty, it is silent,
   and says so by a file CAMERA_PICTURE.silent; without the file it is unplugged. CAMERA_AGE [ns] is
   how old pictures are when they arrive. Of each CAMERA_GROUP pictures the first is marked as
   broken. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

enum { BUFFERS = 32, CAPACITY = 1 << 16 };

/* A memory file with all buffers, which a program maps as those of a device. */
static int device = -1;
static int queue[BUFFERS], taken, queued, width = 64, height = 48, rate = 100;

static int
failed(int code)
{
    errno = code;
    return -1;
}

static int
open_any(const char *symbol, const char *path, int flags, int mode)
{
    int (*next)(const char *, int, ...) = dlsym(RTLD_NEXT, symbol);
    if (strcmp(path, getenv("CAMERA_DEVICE"))) {
        return next(path, flags, mode);
    }
    device = memfd_create("camera", 0);
    return ftruncate(device, (off_t)BUFFERS * CAPACITY) ? -1 : device;
}

#define OPEN(symbol)                                                                               \
    int symbol(const char *path, int flags, ...)                                                   \
    {                                                                                              \
        va_list rest;                                                                              \
        va_start(rest, flags);                                                                     \
        int mode = flags & (O_CREAT | O_DIRECTORY) ? va_arg(rest, int) : 0;                        \
        va_end(rest);                                                                              \
        return open_any(#symbol, path, flags, mode);                                               \
    }
OPEN(open)
OPEN(open64)

static void
fall_silent(const char *picture)
{
    char said[4096];
    snprintf(said, sizeof said, "%s.silent", picture);
    close(creat(said, 0600));
    for (;;) { /* as a driver, whatever signal comes */
        pause();
    }
}

static int
dequeue(struct v4l2_buffer *buffer)
{
    static char picture[CAPACITY];
    struct timespec now;
    nanosleep(&(struct timespec){0, 1000000000 / rate}, NULL);
    const char *path = getenv("CAMERA_PICTURE");
    FILE *file = fopen(path, "rb");
    if (!file) {
        return failed(ENODEV);
    }
    size_t size = fread(picture, 1, CAPACITY, file);
    fclose(file);
    if (!size) {
        fall_silent(path);
    }
    buffer->index = queue[taken % BUFFERS];
    if (pwrite(device, picture, size, (off_t)buffer->index * CAPACITY) < 0) {
        return -1;
    }
    clock_gettime(CLOCK_MONOTONIC, &now);
    long long us = now.tv_sec * 1000000LL + now.tv_nsec / 1000 - atoll(getenv("CAMERA_AGE")) / 1000;
    buffer->timestamp = (struct timeval){us / 1000000, us % 1000000};
    buffer->sequence = taken;
    buffer->bytesused = size;
    buffer->length = CAPACITY;
    buffer->flags = taken++ % atoi(getenv("CAMERA_GROUP")) ? 0 : V4L2_BUF_FLAG_ERROR;
    return 0;
}

static int
answer(unsigned request, void *argument)
{
    const char *code = getenv("CAMERA_FORMAT");
    unsigned format = v4l2_fourcc(code[0], code[1], code[2], code[3]);
    int is_jpeg = format == V4L2_PIX_FMT_MJPEG;
    struct v4l2_capability *capability = argument;
    struct v4l2_pix_format *pixels = &((struct v4l2_format *)argument)->fmt.pix;
    struct v4l2_fmtdesc *description = argument;
    struct v4l2_captureparm *capture = &((struct v4l2_streamparm *)argument)->parm.capture;
    struct v4l2_requestbuffers *buffers = argument;
    struct v4l2_buffer *buffer = argument;
    switch (request) {
    case VIDIOC_QUERYCAP:
        capability->capabilities = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
        return 0;
    case VIDIOC_ENUM_FMT:
        description->pixelformat = format;
        description->flags = is_jpeg ? V4L2_FMT_FLAG_COMPRESSED : 0;
        return description->index ? failed(EINVAL) : 0;
    case VIDIOC_G_INPUT:
        *(int *)argument = 0;
        return 0;
    case VIDIOC_ENUMINPUT:
        return 0;
    case VIDIOC_S_FMT: /* what is wanted, or the nearest */
        width = pixels->width == 32 && pixels->height == 24 ? 32 : 64;
        height = width * 3 / 4;
        /* fall through */
    case VIDIOC_G_FMT:
        pixels->width = width;
        pixels->height = height;
        pixels->pixelformat = format;
        pixels->field = V4L2_FIELD_NONE;
        pixels->bytesperline = is_jpeg ? 0 : 2 * width;
        pixels->sizeimage = is_jpeg ? CAPACITY : 2 * width * height;
        return 0;
    case VIDIOC_S_PARM:
        rate = capture->timeperframe.denominator == 50 * capture->timeperframe.numerator ? 50 : 100;
        /* fall through */
    case VIDIOC_G_PARM:
        capture->capability = V4L2_CAP_TIMEPERFRAME;
        capture->timeperframe = (struct v4l2_fract){1, rate};
        return 0;
    case VIDIOC_REQBUFS:
        if (buffers->count > BUFFERS) {
            buffers->count = BUFFERS;
        }
        return 0;
    case VIDIOC_QUERYBUF:
        buffer->length = CAPACITY;
        buffer->m.offset = buffer->index * CAPACITY;
        return 0;
    case VIDIOC_QBUF:
        queue[queued++ % BUFFERS] = buffer->index;
        return 0;
    case VIDIOC_DQBUF:
        return dequeue(buffer);
    case VIDIOC_STREAMON:
    case VIDIOC_STREAMOFF:
        return 0;
    }
    return failed(ENOTTY);
}

int
ioctl(int file, unsigned long request, ...)
{
    int (*next)(int, unsigned long, ...) = dlsym(RTLD_NEXT, "ioctl");
    va_list rest;
    va_start(rest, request);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    return device >= 0 && file == device ? answer(request, argument)
                                         : next(file, request, argument);
}
