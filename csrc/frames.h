// The interface between darswin.frames and its kernels, which sample one 8-bit frame at the places
// of a plan. Nothing here uses torch.
#pragma once

#include "polar.h"

namespace darswin {

// The rule by which bilinear samples are computed. Each is the operator's rule for some images, so
// that both give the same bits.
//   raw: interpolate, and do not normalize
//   far: interpolate, then normalize; at the border, normalize first
//   near: normalize, then interpolate with weights
//   near_rows: the same, with differences on tiers without registers of 512 bits
enum class Blend { raw, far, near, near_rows };

// The memory of the samples: (points, C) or (C, points) float32, or (points, C) uint8.
enum class FrameOutput { tokens, planes, bytes };

// A point whose four pixels are not all inside the frame.
struct BorderPoint {
  int64_t index;
  int16_t column, row;
  float right, lower;
};

struct FrameArgs {
  const uint8_t* pixels;  // (H, W, C)
  int64_t height, width, channels;
  int64_t row_stride, column_stride, channel_stride;  // bytes; no offset exceeds 31 bits
  // The upper left pixels of the points; 0, 0 for points of `border`. kFrameSpare more are readable
  // behind these arrays.
  const int16_t *columns, *rows;
  const float *right, *lower;  // distances from that pixel, 0 to 1
  int64_t points;
  const BorderPoint* border;
  int64_t border_points;
  const float *scale, *offset;  // (C,): a pixel p has the value p * scale + offset
  Blend blend;
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
  // Samples points [begin, end) on one thread.
  void (*sample)(const FrameArgs& args, int64_t begin, int64_t end);
};

}  // namespace darswin
