// Samples frames of a camera at the places of a plan, which darswin.frames.Plan describes.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "../frames.h"

namespace darswin {

// A frame (H, W, C) of uint8, with C = 1 or 3, in any memory layout. Strides are in bytes; that of
// an axis of size 1 is never used.
struct Frame {
  const uint8_t* pixels;
  int64_t height, width, channels;
  int64_t row_stride, column_stride, channel_stride;
};

// The arrays of a plan.
struct FramePlan {
  std::vector<int64_t> shape;  // of `columns`
  std::span<const int16_t> columns, rows;
  std::span<const float> right, lower;
  int64_t height, width;             // of the frames
  std::vector<float> scale, offset;  // a pixel v becomes v * scale + offset
  std::string output;                // "tokens", "image" or "uint8"
  int64_t reads;
};

// Samples frames of one size at the places of one plan, which it copies. A call changes nothing in
// the object, so several threads may call it at once.
class FrameSampler {
 public:
  // Throws std::invalid_argument if the parts of the plan do not fit together.
  explicit FrameSampler(const FramePlan& plan);

  bool makes_bytes() const { return kind == FrameOutput::bytes; }  // else float32
  // The shape of the samples of a frame with so many channels. `has_axis` says whether a frame has
  // an axis of channels, which samples of bytes then have too.
  std::vector<int64_t> output_shape(int64_t channels, bool has_axis = true) const;

  // Throws std::invalid_argument if a frame does not fit the plan.
  void check(const Frame& frame) const;
  // Writes the samples of a checked frame, on at most num_threads() threads.
  void sample(const Frame& frame, void* out) const;
  // Writes all pixels of a checked frame, normalized: (H, W, C).
  void normalize(const Frame& frame, float* out) const;

 private:
  // A checked frame. It keeps pointers to the arrays of 3 numbers.
  ByteImage image_of(const Frame& frame, float* scale, float* offset) const;

  // The pixel of `seen` before which so many others come.
  int64_t pixel_after(int64_t count) const;

  const int64_t reads;
  const std::vector<int64_t> shape;
  const int64_t height, width;
  const std::vector<float> scale, offset;
  FrameOutput kind;
  int64_t pixels, picture;  // of the output: all, and those of one picture
  std::vector<PixelRun> seen, outside;
  std::vector<int16_t> columns, rows;  // of the points of `seen`
  std::vector<float> right, lower;
  std::vector<BorderPoint> border;
};

}  // namespace darswin
