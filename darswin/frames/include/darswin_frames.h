/* Networks for the frames of one camera, without torch and without Python.
 *
 * `darswin.deploy.camera.export_network` writes a file, once; libdarswin_frames.so runs it. Nothing
 * here throws: a function that fails returns NULL or -1, and darswin_last_error says in a sentence
 * why. */
#ifndef DARSWIN_FRAMES_H
#define DARSWIN_FRAMES_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* A loaded network. Several threads may run one at once. */
typedef struct darswin_network darswin_network;

/* The pixels (height, width, channels) of a frame, RGB or gray. Strides are in bytes and may be
 * negative: {pixels + 2, h, w, 3, 3 * w, 3, -1} are the pixels of a BGR picture as RGB. */
typedef struct {
  const uint8_t* pixels;
  int64_t height, width, channels;
  int64_t row_stride, column_stride, channel_stride;
} darswin_frame;

/* The version of the library, such as "1.2.0", and of the files that it reads, such as "2.0". It
 * reads files of the same first number. */
const char* darswin_version(void);
const char* darswin_file_version(void);

/* Why the last call of this thread failed, until its next call fails. */
const char* darswin_last_error(void);

/* The network of a file, or NULL. darswin_free frees it when no thread runs it any more. */
darswin_network* darswin_load(const char* path);
void darswin_free(darswin_network* network);

/* Writes the size of the frames: height, width, channels. Returns 0, or -1. */
int darswin_frame_size(const darswin_network* network, int64_t size[3]);

/* A classifier has one output, its probabilities; others have maps. An output has `axes` axes of
 * the sizes `shape`, and no function has an output beyond the last one: NULL or -1. */
int64_t darswin_output_count(const darswin_network* network);
int64_t darswin_output_axes(const darswin_network* network, int64_t output);
const int64_t* darswin_output_shape(const darswin_network* network, int64_t output);
int64_t darswin_output_numbers(const darswin_network* network, int64_t output);

/* The names of the classes in UTF-8, if the file has some. */
int64_t darswin_label_count(const darswin_network* network);
const char* darswin_label(const darswin_network* network, int64_t label);

/* Writes the outputs of a frame, darswin_output_numbers each, on at most `threads` threads. Returns
 * 0, or -1. */
int darswin_run(const darswin_network* network, const darswin_frame* frame, float* const* outputs,
                int64_t threads);

#ifdef __cplusplus
}
#endif

#endif
