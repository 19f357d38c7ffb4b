// Samples frames of a camera at the places of a plan, which darswin.frames.Plan describes.
#pragma once

#include <cstdint>
#include <optional>
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

// Throws std::invalid_argument if a frame, called `what`, has not this size, or neither so many
// channels nor, with `channels` = 1, one or three.
void check_frame(const Frame& frame, int64_t height, int64_t width, size_t channels,
                 const std::string& what = "frame");
// A checked frame. It keeps the pointers.
ByteImage image_of(const Frame& frame, const float* scale, const float* offset);

// The output of this name, or nothing.
std::optional<FrameOutput> output_of(const std::string& name);

// Returns about how long it takes to sample so many points, or to normalize so many numbers.
inline double frame_microseconds(int64_t count) { return static_cast<double>(count) / 500; }

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
  void check(const Frame& frame) const { check_frame(frame, height, width, scale.size()); }
  // Writes the samples of a checked frame, on at most num_threads() threads.
  void sample(const Frame& frame, void* out) const;
  // Writes all pixels of a checked frame, normalized: (H, W, C).
  void normalize(const Frame& frame, float* out) const;

 private:
  // Numbers for 3 channels. Bytes are not normalized.
  void normalization(float* scale, float* offset) const;

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
