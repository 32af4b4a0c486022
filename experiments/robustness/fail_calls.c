/* Lets the n-th call that touches a file in a folder fail, whichever library makes it: a preloaded library.

       cc -shared -fPIC -O1 -o fail_calls.so fail_calls.c -ldl
       LD_PRELOAD=./fail_calls.so FAIL_IN=/folder/ FAIL_AT=12 FAIL_KIND=EIO python ...

   FAIL_KIND is EIO, ENOSPC, "short" (a write of half of the bytes; other calls fail with EIO), or the number of a
   signal. `fail_calls_count` tells how many calls there have been; with FAIL_LOG each one's name and path are printed. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

static atomic_int count;

int fail_calls_count(void) { return count; }

/* Says whether this call has to fail: 0 no, 1 yes (errno is set), 2 as a short write. */
static int due(const char *name, const char *path) {
    const char *folder = getenv("FAIL_IN"), *at = getenv("FAIL_AT"), *kind = getenv("FAIL_KIND");
    if (!folder || !at || !kind || !path || strncmp(path, folder, strlen(folder))) return 0;
    int mine = atomic_fetch_add(&count, 1) + 1;
    if (getenv("FAIL_LOG")) dprintf(2, "call %d %s %s\n", mine, name, path + strlen(folder));
    if (mine != atoi(at)) return 0;
    if (atoi(kind)) {
        kill(getpid(), atoi(kind));
        return 0;
    }
    errno = strcmp(kind, "ENOSPC") ? EIO : ENOSPC;
    return strcmp(kind, "short") ? 1 : 2;
}

/* Makes a path absolute. */
static const char *absolute(int folder, const char *path, char *room) {
    if (!path || path[0] == '/') return path;
    char link[64], base[PATH_MAX];
    ssize_t length = -1;
    if (folder == AT_FDCWD) {
        if (getcwd(base, sizeof base)) length = (ssize_t)strlen(base);
    } else {
        snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
        length = readlink(link, base, sizeof base - 1);
    }
    if (length < 0 || snprintf(room, PATH_MAX, "%.*s/%s", (int)length, base, path) >= PATH_MAX) return NULL;
    return room;
}

/* Finds the path of an open file. */
static const char *opened(int file, char *room) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, room, PATH_MAX - 1);
    if (length < 0) return NULL;
    room[length] = 0;
    return room;
}

#define REAL(name) __typeof__(&name) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)
#define BY_PATH(name, declared, folder, path, given)                              \
    int name declared {                                                           \
        char room[PATH_MAX];                                                      \
        if (due(#name, absolute(folder, path, room))) return -1;                  \
        REAL(name);                                                               \
        return real given;                                                        \
    }
#define BY_FILE(name, declared, given)                                            \
    int name declared {                                                           \
        char room[PATH_MAX];                                                      \
        if (due(#name, opened(file, room))) return -1;                            \
        REAL(name);                                                               \
        return real given;                                                        \
    }
#define WRITE(name, type, declared, given)                                        \
    type name declared {                                                          \
        char room[PATH_MAX];                                                      \
        int how = due(#name, opened(file, room));                                 \
        if (how == 1 || (how == 2 && size < 2)) return -1;                        \
        if (how == 2) size /= 2;                                                  \
        REAL(name);                                                               \
        return real given;                                                        \
    }
#define VECTOR(name, declared, given) WRITE(name, ssize_t, declared, given)
#define STREAM(name)                                                              \
    FILE *name(const char *path, const char *how) {                               \
        char room[PATH_MAX];                                                      \
        if (due(#name, absolute(AT_FDCWD, path, room))) return NULL;              \
        REAL(name);                                                               \
        return real(path, how);                                                   \
    }
#define NEEDS_MODE(how) ((how) & O_CREAT || ((how) & O_TMPFILE) == O_TMPFILE)
#define OPEN(name)                                                                \
    int name(const char *path, int how, ...) {                                    \
        char room[PATH_MAX];                                                      \
        va_list more;                                                             \
        va_start(more, how);                                                      \
        mode_t mode = NEEDS_MODE(how) ? va_arg(more, mode_t) : 0;                 \
        va_end(more);                                                             \
        if (due(#name, absolute(AT_FDCWD, path, room))) return -1;                \
        REAL(name);                                                               \
        return real(path, how, mode);                                             \
    }
#define OPENAT(name)                                                              \
    int name(int folder, const char *path, int how, ...) {                        \
        char room[PATH_MAX];                                                      \
        va_list more;                                                             \
        va_start(more, how);                                                      \
        mode_t mode = NEEDS_MODE(how) ? va_arg(more, mode_t) : 0;                 \
        va_end(more);                                                             \
        if (due(#name, absolute(folder, path, room))) return -1;                  \
        REAL(name);                                                               \
        return real(folder, path, how, mode);                                     \
    }

OPEN(open)
OPEN(open64)
OPENAT(openat)
OPENAT(openat64)
WRITE(write, ssize_t, (int file, const void *bytes, size_t size), (file, bytes, size))
WRITE(pwrite, ssize_t, (int file, const void *bytes, size_t size, off_t at), (file, bytes, size, at))
WRITE(pwrite64, ssize_t, (int file, const void *bytes, size_t size, off64_t at), (file, bytes, size, at))
VECTOR(writev, (int file, const struct iovec *parts, int size), (file, parts, size))
VECTOR(readv, (int file, const struct iovec *parts, int size), (file, parts, size))
VECTOR(pwritev, (int file, const struct iovec *parts, int size, off_t at), (file, parts, size, at))
VECTOR(preadv, (int file, const struct iovec *parts, int size, off_t at), (file, parts, size, at))
STREAM(fopen)
STREAM(fopen64)
WRITE(read, ssize_t, (int file, void *bytes, size_t size), (file, bytes, size))
WRITE(pread, ssize_t, (int file, void *bytes, size_t size, off_t at), (file, bytes, size, at))
WRITE(pread64, ssize_t, (int file, void *bytes, size_t size, off64_t at), (file, bytes, size, at))
BY_FILE(fsync, (int file), (file))
BY_FILE(fdatasync, (int file), (file))
BY_FILE(ftruncate, (int file, off_t size), (file, size))
BY_FILE(ftruncate64, (int file, off64_t size), (file, size))
BY_FILE(flock, (int file, int how), (file, how))
BY_PATH(mkdir, (const char *path, mode_t mode), AT_FDCWD, path, (path, mode))
BY_PATH(mkdirat, (int folder, const char *path, mode_t mode), folder, path, (folder, path, mode))
BY_PATH(rmdir, (const char *path), AT_FDCWD, path, (path))
BY_PATH(unlink, (const char *path), AT_FDCWD, path, (path))
BY_PATH(unlinkat, (int folder, const char *path, int how), folder, path, (folder, path, how))
BY_PATH(rename, (const char *path, const char *to), AT_FDCWD, path, (path, to))
BY_PATH(renameat, (int folder, const char *path, int other, const char *to), folder, path, (folder, path, other, to))
BY_PATH(link, (const char *path, const char *to), AT_FDCWD, path, (path, to))
