/* A bare loop of libmodbus: one thread for each port reads registers again and again. The measure of what
 * busker does over TCP; says how much processor time it took.
 *
 * Use: libmodbus_loop SECONDS REGISTERS UNITS PORT... */
#include <errno.h>
#include <modbus.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/resource.h>
#include <time.h>

static int registers, units;
static struct timespec end;

static int is_over(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec > end.tv_sec || (now.tv_sec == end.tv_sec && now.tv_nsec >= end.tv_nsec);
}

static void *loop(void *port) {
    uint16_t words[125];
    modbus_t *line = modbus_new_tcp("127.0.0.1", *(int *)port);
    if (line == NULL || modbus_connect(line) == -1) {
        fprintf(stderr, "libmodbus does not connect: %s\n", modbus_strerror(errno));
        exit(1);
    }
    for (int unit = 1; !is_over(); unit = unit % units + 1) {
        modbus_set_slave(line, unit);
        if (modbus_read_registers(line, 0, registers, words) != registers) {
            fprintf(stderr, "libmodbus does not read: %s\n", modbus_strerror(errno));
            exit(1);
        }
    }
    modbus_close(line);
    modbus_free(line);
    return NULL;
}

int main(int count, char **words) {
    if (count < 5) return 2;
    clock_gettime(CLOCK_MONOTONIC, &end);
    end.tv_sec += atoi(words[1]);
    registers = atoi(words[2]);
    units = atoi(words[3]);
    pthread_t threads[64];
    int ports[64], used = 0;
    for (int at = 4; at < count && used < 64; at++, used++) {
        ports[used] = atoi(words[at]);
        pthread_create(&threads[used], NULL, loop, &ports[used]);
    }
    for (int at = 0; at < used; at++) pthread_join(threads[at], NULL);
    struct rusage usage;
    getrusage(RUSAGE_SELF, &usage);
    printf("%.6f\n", usage.ru_utime.tv_sec + usage.ru_stime.tv_sec +
                         (usage.ru_utime.tv_usec + usage.ru_stime.tv_usec) / 1e6);
    return 0;
}
