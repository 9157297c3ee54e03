/* Device under test in C99 and POSIX sockets: it trips the shaft if the disk moves too far, and reports danger.
 *
 * Needs a rig in lockstep with a socketcand server. Layout of the frames: drivers/can/rig.dbc.
 *
 *     cc -O2 -o plain_device plain_device.c -lm
 *     ./plain_device 127.0.0.1:29536 1500        (limit of the radius in um)
 */
#define _POSIX_C_SOURCE 200809L
#include <arpa/inet.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

enum { COMMAND = 0x020, ACKNOWLEDGE = 0x021, DEVICE = 0x023, DEVICE_STATE = 0x024 };
enum { SAMPLES_1 = 0x201, BLOCK = 0x320, HEARTBEAT = 0x701 };
enum { JOIN = 0x0F, DONE = 0xF0, NOTE = 0xCC, ANNOUNCE = 0x55, SPEED = 0x5C }; /* first byte of a frame */
enum { DANGER = 2, TRIP = 4, DISK_X = 6, NO_VALUE = 0x800 };                   /* fields of a note */
enum { NODE = 7, KEY = 0x9D, LEAD = NODE, STALE = 6, ANY = 256 }; /* LEAD: of the shared counter, 1 to 15 */

static const double MM_PER_COUNT = 0.00015491156408629442, OFFSET_MM = 2.5380710659898478;

struct frame {
    unsigned identifier;
    unsigned char data[8];
};

static int link_fd;
static FILE *received;
static unsigned char counter; /* of the last command on the bus */

static void fail(const char *text) {
    fprintf(stderr, "%s\n", text);
    exit(1);
}

/* Read one "< ... >" of socketcand; return 0 at the end of the run. */
static int read_text(char *text, size_t size) {
    size_t n = 0;
    int c;
    while ((c = fgetc(received)) != EOF && c != '>')
        if (n + 1 < size) text[n++] = (char)c;
    text[n] = 0;
    return c == '>';
}

/* Read the next frame; return 0 at the end of the run. */
static int read_frame(struct frame *f) {
    char text[256], hex[17];
    int i;
    unsigned byte;
    while (read_text(text, sizeof text)) {
        if (sscanf(text, " < frame %x %*s %16[0-9A-F]", &f->identifier, hex) != 2) continue;
        memset(f->data, 0, sizeof f->data);
        for (i = 0; hex[2 * i] && hex[2 * i + 1] && sscanf(hex + 2 * i, "%2x", &byte) == 1; i++)
            f->data[i] = (unsigned char)byte;
        return 1;
    }
    return 0;
}

static void write_text(const char *text) {
    size_t left = strlen(text);
    while (left) {
        ssize_t n = write(link_fd, text + strlen(text) - left, left);
        if (n <= 0) fail("the bus was closed");
        left -= (size_t)n;
    }
}

/* Send six bytes, the key, and a CRC-8 (SAE J1850) over identifier and these seven; return the CRC. */
static unsigned char send_frame(unsigned identifier, const unsigned char first[6]) {
    unsigned char all[10] = {(unsigned char)identifier, (unsigned char)(identifier >> 8)}, crc = 0xFF;
    char text[64];
    int i, bit, n;
    memcpy(all + 2, first, 6);
    all[8] = KEY;
    for (i = 0; i < 9; i++)
        for (crc ^= all[i], bit = 0; bit < 8; bit++) crc = (unsigned char)(crc & 0x80 ? crc << 1 ^ 0x1D : crc << 1);
    all[9] = crc ^ 0xFF;
    n = sprintf(text, "< send %x 8", identifier);
    for (i = 2; i < 10; i++) n += sprintf(text + n, " %02x", all[i]);
    strcat(text, " >");
    if (identifier != COMMAND) write_text(text);
    else {
        /* The frame before a command names its sender: counter and checksum of the command. */
        unsigned char sender[6] = {ANNOUNCE, NODE, first[1], all[9]};
        send_frame(DEVICE, sender);
        write_text(text);
    }
    return all[9];
}

/* Send a note with a value in um of at most 20470, in steps of 10 um. */
static void send_note(unsigned kind, unsigned channel, double value_um) {
    unsigned number = value_um < 0 ? NO_VALUE : (unsigned)(value_um / 10 + 0.5) & 0x7FF;
    unsigned exponent = value_um < 0 ? 0 : 1;
    unsigned char first[6] = {NOTE, NODE, (unsigned char)kind, (unsigned char)channel, (unsigned char)number};
    first[5] = (unsigned char)(number >> 8 | exponent << 4);
    send_frame(DEVICE, first);
}

static void wait_for(unsigned identifier, unsigned first, struct frame *f) {
    do {
        if (!read_frame(f)) fail("the bus was closed");
    } while (f->identifier != identifier || (first < 256 && f->data[0] != first));
}

/* Command 0 Hz; all senders share a counter, and a heartbeat repeats it if another one was first. */
static void stop_shaft(void) {
    unsigned char speed[6] = {SPEED};
    struct frame f;
    do {
        speed[1] = (unsigned char)(counter + LEAD);
        send_frame(COMMAND, speed);
        wait_for(ACKNOWLEDGE, speed[1], &f);
        if ((f.data[1] & 0x0F) == STALE) {
            wait_for(HEARTBEAT, ANY, &f);
            counter = f.data[2];
        } else if (f.data[1] & 0x0F) fail("the trip was refused");
    } while (f.identifier == HEARTBEAT);
}

int main(int argc, char **argv) {
    struct sockaddr_in address = {0};
    struct frame f;
    char text[256], *colon = argc == 3 ? strchr(argv[1], ':') : NULL;
    unsigned char join[6] = {JOIN, NODE}, done[6] = {DONE, NODE};
    double limit_um, radius_um = 0.0;
    int tripped = 0;

    if (!colon) fail("usage: plain_device HOST:PORT LIMIT_UM");
    limit_um = atof(argv[2]);
    *colon = 0;
    address.sin_family = AF_INET;
    address.sin_port = htons((uint16_t)atoi(colon + 1));
    if (inet_pton(AF_INET, argv[1], &address.sin_addr) != 1) fail("HOST must be an IPv4 address");
    link_fd = socket(AF_INET, SOCK_STREAM, 0);
    if (connect(link_fd, (struct sockaddr *)&address, sizeof address)) fail("no socketcand server there");
    received = fdopen(link_fd, "r");
    if (!received || !read_text(text, sizeof text)) fail("no greeting"); /* hi */
    write_text("< open can0 >");
    read_text(text, sizeof text); /* ok */
    write_text("< rawmode >");
    read_text(text, sizeof text);

    wait_for(HEARTBEAT, ANY, &f);
    counter = f.data[2];
    send_frame(DEVICE, join);
    wait_for(DEVICE_STATE, NODE, &f);
    if (f.data[1] != 1) fail("the rig refused the device");
    puts("joined");
    fflush(stdout);

    while (read_frame(&f)) {
        if (f.identifier == SAMPLES_1) {
            double x_mm = (int16_t)(f.data[2] | f.data[3] << 8) * MM_PER_COUNT + OFFSET_MM;
            double y_mm = (int16_t)(f.data[4] | f.data[5] << 8) * MM_PER_COUNT + OFFSET_MM;
            radius_um = fmax(radius_um, 1000.0 * hypot(x_mm, y_mm));
        } else if (f.identifier == DEVICE_STATE && f.data[0] == NODE) {
            fail("the rig has removed the device");
        } else if (f.identifier == BLOCK) {
            memcpy(done + 2, f.data, 4); /* number of the block */
            if (radius_um > limit_um && !tripped) {
                tripped = 1;
                send_note(DANGER, DISK_X, radius_um);
                stop_shaft();
                send_note(TRIP, 0, -1.0);
                printf("tripped at %.0f um\n", radius_um);
            }
            send_frame(DEVICE, done);
        }
    }
    return 0;
}
