#include "rig.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <stdexcept>

#include "dispatch.h"
#include "parallel.h"

namespace darswin {

RigSampler::RigSampler(const RigPlan& plan)
    : height(plan.height),
      width(plan.width),
      sizes(plan.sizes),
      sources(plan.names),
      scale(plan.scale),
      offset(plan.offset) {
  const size_t reads = plan.sources.size(), count = plan.counts.size();
  const auto output = output_of(plan.output);
  const bool lengths = plan.columns.size() == reads && plan.rows.size() == reads &&
                       plan.right.size() == reads && plan.lower.size() == reads &&
                       plan.weights.size() == reads &&
                       std::accumulate(plan.counts.begin(), plan.counts.end(), size_t{0}) == reads;
  const bool cameras =
      !sizes.empty() && sizes.size() <= UINT8_MAX && sizes.size() == sources.size();
  const bool channels = (scale.size() == 1 || scale.size() == 3) && scale.size() == offset.size();
  if (!output || output == FrameOutput::tokens || !lengths || !cameras || !channels) {
    throw std::invalid_argument("the parts of the plan do not fit together");
  }
  kind = *output;
  for (const auto& [rows, columns] : sizes) {
    if (rows < 2 || columns < 2 || rows > INT16_MAX || columns > INT16_MAX) {
      throw std::invalid_argument(
          "the frames of the plan's cameras must have 2 to 32767 rows and "
          "columns");
    }
  }
  for (size_t k = 0; k < reads; ++k) {
    const float x = plan.right[k], y = plan.lower[k], weight = plan.weights[k];
    if (plan.sources[k] >= sizes.size()) {
      throw std::invalid_argument("the plan reads a camera that it does not name");
    }
    const auto& [rows, columns] = sizes[plan.sources[k]];
    if (plan.columns[k] < 0 || plan.rows[k] < 0 || plan.columns[k] > columns - 2 ||
        plan.rows[k] > rows - 2 || !(x >= 0 && x <= 1 && y >= 0 && y <= 1)) {
      throw std::invalid_argument("the plan has places outside of the frame of " +
                                  sources[plan.sources[k]]);
    }
    if (!(weight >= 0 && weight <= std::numeric_limits<float>::max())) {
      throw std::invalid_argument("the plan's weights must be finite and not below 0");
    }
  }
  for (size_t pixel = 0, read = 0, end, next; pixel < count; pixel = end, read = next) {
    const bool seen = plan.counts[pixel] > 0;
    next = read + plan.counts[pixel];
    for (end = pixel + 1; end < count && (plan.counts[end] > 0) == seen &&
                          next + plan.counts[end] <= read + kRigReads;) {
      next += plan.counts[end++];
    }
    add_group(plan, pixel, end, read);
  }
  add_group(plan, count, count, reads);
  for (auto* places : {&columns, &rows}) places->resize(reads + kFrameSpare);
  for (auto* numbers : {&right, &lower}) numbers->resize(reads + kFrameSpare);
}

void RigSampler::add_group(const RigPlan& plan, int64_t begin, int64_t end, int64_t read) {
  groups.push_back({begin, read, static_cast<int64_t>(runs.size())});
  std::vector<std::pair<int64_t, uint8_t>> reads;  // and their pixels
  for (int64_t pixel = begin; pixel < end; ++pixel) {
    for (int k = 0; k < plan.counts[pixel]; ++k) {
      reads.emplace_back(read++, static_cast<uint8_t>(pixel - begin));
    }
  }
  // Blocks of one source are long, and a pixel has few reads of each.
  std::stable_sort(reads.begin(), reads.end(), [&](const auto& a, const auto& b) {
    return plan.sources[a.first] < plan.sources[b.first];
  });
  int last = -1;
  for (const auto& [k, pixel] : reads) {
    if (runs.size() == static_cast<size_t>(groups.back().run) ||
        runs.back().source != plan.sources[k]) {
      runs.push_back({0, plan.sources[k], true, true});
      last = pixel - 1;
    }
    ++runs.back().count;
    runs.back().in_order &= pixel == ++last;
    runs.back().unweighted &= plan.weights[k] == 1;
    columns.push_back(plan.columns[k]), rows.push_back(plan.rows[k]);
    right.push_back(plan.right[k]), lower.push_back(plan.lower[k]);
    weights.push_back(plan.weights[k]), pixels.push_back(pixel);
  }
}

std::vector<int64_t> RigSampler::output_shape(int64_t channels, bool has_axis) const {
  if (!makes_bytes()) return {channels, height, width};
  if (!has_axis) return {height, width};
  return {height, width, channels};
}

void RigSampler::check(std::span<const Frame> frames) const {
  for (size_t k = 0; k < frames.size(); ++k) {
    const std::string what = "the frame of " + sources[k];
    check_frame(frames[k], sizes[k].first, sizes[k].second, scale.size(), what);
    if (frames[k].channels != frames[0].channels) {
      throw std::invalid_argument(what + " must have as many channels as that of " + sources[0] +
                                  ", " + std::to_string(frames[0].channels) + ", got " +
                                  std::to_string(frames[k].channels));
    }
  }
}

void RigSampler::sample(std::span<const Frame> frames, void* out) const {
  static constexpr float kOnes[] = {1, 1, 1}, kZeros[] = {0, 0, 0};
  float scales[3], offsets[3];
  for (int c = 0; c < 3; ++c) {
    const size_t at = scale.size() > 1 ? c : 0;
    scales[c] = scale[at], offsets[c] = offset[at];
  }
  std::vector<ByteImage> images;
  for (const Frame& frame : frames) images.push_back(image_of(frame, kOnes, kZeros));
  const RigArgs a{.images = images.data(),
                  .columns = columns.data(),
                  .rows = rows.data(),
                  .right = right.data(),
                  .lower = lower.data(),
                  .weights = weights.data(),
                  .pixels = pixels.data(),
                  .groups = groups.data(),
                  .runs = runs.data(),
                  .scale = scales,
                  .offset = offsets,
                  .to = {kind, frames[0].channels, height * width, out}};
  const auto& kernel = kernels<FrameKernels>();
  parallel_ranges(static_cast<int64_t>(groups.size()) - 1,
                  threads_for(frame_microseconds(static_cast<int64_t>(pixels.size()))),
                  [&](int64_t begin, int64_t end) { kernel.sample_rig(a, begin, end); });
}

}  // namespace darswin
