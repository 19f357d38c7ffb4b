// The interface between darswin.frames and its kernels, which sample one 8-bit frame at the places
// of a plan. Nothing here uses torch.
#pragma once

#include "polar.h"

namespace darswin {

// The memory of the samples: (pixels, C) or (C, pixels) float32, or (pixels, C) uint8. If the
// output has several pictures, they follow each other.
enum class FrameOutput { tokens, planes, bytes };

struct ByteImage {
  const uint8_t* pixels;  // (H, W, C), with C = 1 or 3
  int64_t height, width, channels;
  int64_t row_stride, column_stride, channel_stride;  // no offset exceeds 31 bits
  const float *scale, *offset;  // (C,): a sample v of the pixels becomes v * scale + offset
};

// A point whose four pixels are not all inside the frame.
struct BorderPoint {
  int64_t index;
  int16_t column, row;
  float right, lower;
};

struct FrameArgs {
  ByteImage image;
  // The upper left pixels of the points; 0, 0 for points of `border`. kFrameSpare more are readable
  // behind these arrays.
  const int16_t *columns, *rows;
  const float *right, *lower;  // distances from that pixel, 0 to 1
  int64_t points;
  int64_t reads;   // points of a pixel of the output, one after the other: it is their mean
  int64_t pixels;  // of one picture of the output
  const BorderPoint* border;
  int64_t border_points;
  FrameOutput output;
  void* out;
};
constexpr int64_t kFrameSpare = 16;

struct FrameKernels {
  // Finds the upper left pixel of each point of a polar grid, and the distances from it, as arrays
  // (num_radii, num_azimuths). `angles` begins with the azimuths. It has room for three rows of
  // `padded` numbers, a multiple of 8 and at least 8 more than the azimuths.
  void (*places)(PolarSampleArgs<float> args, double* angles, int64_t padded, int16_t* columns,
                 int16_t* rows, float* right, float* lower);
  // Samples points [begin, end), of whole pixels, on one thread.
  void (*sample)(const FrameArgs& args, int64_t begin, int64_t end);
};

}  // namespace darswin
