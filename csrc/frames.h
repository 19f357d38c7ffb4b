// The interface between darswin.frames and its kernels, which sample 8-bit frames at the places of
// a plan. Nothing here uses torch.
#pragma once

#include "polar.h"

namespace darswin {

// The memory of the samples: (pixels, C) or (C, pixels) float32, or (pixels, C) uint8. If the
// output has several pictures, they follow each other.
enum class FrameOutput { tokens, planes, bytes };
struct FrameTarget {
  FrameOutput output;
  int64_t channels, pixels;  // of one picture
  void* out;
};

struct ByteImage {
  const uint8_t* pixels;  // (H, W, C), with C = 1 or 3
  int64_t height, width, channels;
  int64_t row_stride, column_stride, channel_stride;  // no offset exceeds 31 bits
  const float *scale, *offset;  // (C,): a sample v of the pixels becomes v * scale + offset
};

// A point of a pixel of the output that reads the frame's border: some of the pixels around its
// points are inside the frame, and some are not.
struct BorderPoint {
  int64_t pixel;
  int16_t column, row;
  float right, lower;
};

// Pixels [begin, end) of one picture of the output, with so many pixels in the runs before.
struct PixelRun {
  int64_t begin, end, before;
};
struct PixelRuns {
  const PixelRun* runs;
  int64_t count;
};

struct FrameArgs {
  ByteImage image;
  // The upper left pixels of the points of all pixels in `seen`; 0, 0 if their neighbours are not
  // all inside. kFrameSpare more are readable behind these arrays.
  const int16_t *columns, *rows;
  const float *right, *lower;  // distances from that pixel, 0 to 1
  int64_t reads;      // points of a pixel of the output, one after the other: it is their mean
  PixelRuns seen;     // all pixels that see something of the frame, and those in short gaps
  PixelRuns outside;  // all pixels that see nothing
  const BorderPoint* border;
  int64_t border_points;
  FrameTarget to;
};
constexpr int64_t kFrameSpare = 16;

// Pixels of a rig's output that follow each other and have kRigReads reads at most, or one with
// more, or any number of pixels without reads. The next group begins where this one ends.
struct RigGroup {
  int64_t pixel, read, run;
};
constexpr int64_t kRigReads = 256;

// Reads of one source that follow each other in a group.
struct RigRun {
  int32_t count;
  uint8_t source;
  bool in_order;    // they belong to pixels that follow each other
  bool unweighted;  // all weights are 1
};

// A pixel is the sum of its reads, which are bilinear samples times their weights.
struct RigArgs {
  const ByteImage* images;  // of the sources; they are not normalized
  // Of the reads as in FrameArgs, with their weights, and the number of their pixel in the group.
  const int16_t *columns, *rows;
  const float *right, *lower, *weights;
  const uint8_t* pixels;
  const RigGroup* groups;  // one that begins at the end is the last
  const RigRun* runs;
  const float *scale, *offset;  // (C,): a sum v becomes v * scale + offset
  FrameTarget to;
};

struct FrameKernels {
  // Finds the upper left pixel of each point of a polar grid, and the distances from it, as arrays
  // (num_radii, num_azimuths). `angles` begins with the azimuths. It has room for three rows of
  // `padded` numbers, a multiple of 8 and at least 8 more than the azimuths.
  void (*places)(PolarSampleArgs<float> args, double* angles, int64_t padded, int16_t* columns,
                 int16_t* rows, float* right, float* lower);
  // Samples pixels [begin, end) of the output on one thread.
  void (*sample)(const FrameArgs& args, int64_t begin, int64_t end);
  // Samples groups [begin, end) of a rig's output on one thread.
  void (*sample_rig)(const RigArgs& args, int64_t begin, int64_t end);
};

// A picture (H, W, C) of uint8_t or float that is read at points of float, 0 outside.
template <typename T>
struct ReadArgs {
  const T* picture;
  int64_t height, width, channels;  // at most 2^24, and not 0
  const float* points;              // x and y, (k rows, k columns, 2)
  int64_t columns, reads;           // of `to`, and k
  T* to;                            // (rows, columns, C): each is the mean of k² points
};

template <typename T>
struct ReadKernels {
  void (*any)(const ReadArgs<T>& args, int64_t rows);  // of any number of channels
  void (*three)(const ReadArgs<T>& args, int64_t rows);
  void (*four)(const ReadArgs<T>& args, int64_t rows);
};

}  // namespace darswin
