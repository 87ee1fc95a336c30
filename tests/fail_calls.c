/* Lets one call of the C library fail, chosen by its number: cc -shared -fPIC fail_calls.c -o fail_calls.so -ldl, then
   LD_PRELOAD. A write that fails has written half. Calls count from fail_arm(number, error) on; fail_seen() disarms and
   tells how many there were. */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

static long chosen = -1, seen = 0;
static int error = 0, armed = 0;
static char names[65536];
static size_t length = 0;

void fail_arm(long number, int with) { chosen = number, error = with, seen = 0, armed = 1, length = 0; }
long fail_seen(void) { armed = 0; return seen; }
const char *fail_names(void) { return names; }

static int fails(const char *name) {
    if (!armed) return 0;
    if (length + 32 < sizeof names) length += snprintf(names + length, 32, "%s ", name);
    if (++seen != chosen) return 0;
    errno = error;
    return 1;
}

#define REAL(name) static __typeof__(name) *real; if (!real) real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name)
#define HOOK(result, bad, name, parameters, arguments)      \
    result name parameters {                                \
        REAL(name);                                         \
        return fails(#name) ? bad : real arguments;         \
    }
#define OPEN(name, parameters, arguments)                   \
    int name parameters {                                   \
        REAL(name);                                         \
        mode_t mode = 0;                                    \
        if (flags & (O_CREAT | O_TMPFILE)) {                \
            va_list more;                                   \
            va_start(more, flags);                          \
            mode = va_arg(more, mode_t);                    \
            va_end(more);                                   \
        }                                                   \
        return fails(#name) ? -1 : real arguments;          \
    }

OPEN(open, (const char *path, int flags, ...), (path, flags, mode))
OPEN(open64, (const char *path, int flags, ...), (path, flags, mode))
OPEN(openat, (int folder, const char *path, int flags, ...), (folder, path, flags, mode))
OPEN(openat64, (int folder, const char *path, int flags, ...), (folder, path, flags, mode))
HOOK(int, -1, fsync, (int file), (file))
HOOK(int, -1, rename, (const char *from, const char *to), (from, to))
HOOK(int, -1, unlink, (const char *path), (path))
HOOK(int, -1, mkdir, (const char *path, mode_t mode), (path, mode))
HOOK(int, -1, fstat, (int file, struct stat *found), (file, found))
HOOK(int, -1, fstat64, (int file, struct stat64 *found), (file, found))
HOOK(int, -1, stat, (const char *path, struct stat *found), (path, found))
HOOK(int, -1, stat64, (const char *path, struct stat64 *found), (path, found))
HOOK(int, -1, lstat, (const char *path, struct stat *found), (path, found))
HOOK(int, -1, lstat64, (const char *path, struct stat64 *found), (path, found))
HOOK(ssize_t, -1, read, (int file, void *data, size_t size), (file, data, size))
HOOK(off_t, -1, lseek, (int file, off_t place, int from), (file, place, from))
HOOK(off64_t, -1, lseek64, (int file, off64_t place, int from), (file, place, from))
HOOK(DIR *, NULL, opendir, (const char *path), (path))
HOOK(struct dirent *, NULL, readdir, (DIR *folder), (folder))
HOOK(struct dirent64 *, NULL, readdir64, (DIR *folder), (folder))

ssize_t write(int file, const void *data, size_t size) {
    REAL(write);
    if (!fails("write")) return real(file, data, size);
    int with = errno;
    if (size > 1 && real(file, data, size / 2) < 0) return -1;
    errno = with;
    return -1;
}

int close(int file) {
    REAL(close);
    if (!fails("close")) return real(file);
    int with = errno;
    real(file);
    errno = with;
    return -1;
}
