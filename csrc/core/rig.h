// Samples the frames of several cameras at the places of a plan, which darswin.frames.RigPlan
// describes.
#pragma once

#include "frame.h"

namespace darswin {

// The arrays of a plan.
struct RigPlan {
  std::span<const uint16_t> counts;  // of each pixel
  std::span<const uint8_t> sources;  // of each read
  std::span<const int16_t> columns, rows;
  std::span<const float> right, lower, weights;
  int64_t height, width;  // of the output
  std::vector<std::pair<int64_t, int64_t>> sizes;
  std::vector<std::string> names;
  std::vector<float> scale, offset;  // as in FramePlan
  std::string output;                // "image" or "uint8"
};

// Samples frames at the places of one plan, which it copies. A call changes nothing in the object,
// so several threads may call it at once.
class RigSampler {
 public:
  // Throws std::invalid_argument if the parts of the plan do not fit together.
  explicit RigSampler(const RigPlan& plan);

  bool makes_bytes() const { return kind == FrameOutput::bytes; }  // else float32
  std::vector<int64_t> output_shape(int64_t channels, bool has_axis) const;
  const std::vector<std::string>& names() const { return sources; }

  // Throws std::invalid_argument if the frames, one for each name, do not fit the plan.
  void check(std::span<const Frame> frames) const;
  // Writes the samples of checked frames, on at most num_threads() threads.
  void sample(std::span<const Frame> frames, void* out) const;

 private:
  // Appends the reads of one group of pixels from a plan.
  void add_group(const RigPlan& plan, int64_t begin, int64_t end, int64_t read);

  const int64_t height, width;
  const std::vector<std::pair<int64_t, int64_t>> sizes;
  const std::vector<std::string> sources;
  const std::vector<float> scale, offset;
  FrameOutput kind;
  std::vector<RigGroup> groups;
  std::vector<RigRun> runs;
  std::vector<int16_t> columns, rows;  // of the reads of all runs
  std::vector<float> right, lower, weights;
  std::vector<uint8_t> pixels;
};

}  // namespace darswin
