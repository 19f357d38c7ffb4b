#include "frame.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "dispatch.h"
#include "parallel.h"

namespace darswin {
namespace {

constexpr int64_t kMostReads = 16;       // along a side of a pixel: all points fit one block
constexpr double kPerMicrosecond = 500;  // points, or numbers of a frame that are normalized

template <typename T>
std::vector<T> padded(std::span<const T> array) {
  std::vector<T> values(array.begin(), array.end());
  values.resize(values.size() + kFrameSpare);
  return values;
}

std::string shown(int64_t height, int64_t width) {
  return "(" + std::to_string(height) + ", " + std::to_string(width) + ")";
}

}  // namespace

FrameSampler::FrameSampler(const FramePlan& plan)
    : reads(plan.reads >= 1 && plan.reads <= kMostReads ? plan.reads * plan.reads : 0),
      shape(plan.shape.begin(), plan.shape.end() - (plan.reads > 1 && !plan.shape.empty())),
      columns(padded(plan.columns)),
      rows(padded(plan.rows)),
      right(padded(plan.right)),
      lower(padded(plan.lower)),
      height(plan.height),
      width(plan.width),
      scale(plan.scale),
      offset(plan.offset) {
  const size_t points = plan.columns.size();
  const bool tokens = plan.output == "tokens",
             known = tokens || plan.output == "image" || plan.output == "uint8";
  const bool sizes = height > 0 && width > 0 && height <= INT16_MAX && width <= INT16_MAX;
  const bool channels = scale.size() == 1 || scale.size() == 3;
  const bool axes =
      tokens ? shape.size() == 4 && reads == 1 : shape.size() == 2 || shape.size() == 3;
  if (!known || !sizes || !channels || scale.size() != offset.size() || reads < 1 || !axes ||
      (reads > 1 && plan.shape.back() != reads) || plan.rows.size() != points ||
      plan.right.size() != points || plan.lower.size() != points) {
    throw std::invalid_argument("the parts of the plan do not fit together");
  }
  kind = tokens                   ? FrameOutput::tokens
         : plan.output == "image" ? FrameOutput::planes
                                  : FrameOutput::bytes;
  for (size_t k = 0; k < points; ++k) {
    const float x = right[k], y = lower[k];
    if (!(x >= 0 && x <= 1 && y >= 0 && y <= 1)) {
      throw std::invalid_argument("the plan has distances outside of [0, 1]");
    }
  }
  for (int64_t first = 0; first < static_cast<int64_t>(points); first += reads) {
    bool inside = true;
    for (int64_t k = first; k < first + reads; ++k) {
      inside &= columns[k] >= 0 && rows[k] >= 0 && columns[k] < width - 1 && rows[k] < height - 1;
    }
    for (int64_t k = first; k < first + reads && !inside; ++k) {
      border.push_back({k, columns[k], rows[k], right[k], lower[k]});
      columns[k] = rows[k] = 0;
    }
  }
}

std::vector<int64_t> FrameSampler::output_shape(int64_t channels, bool has_axis) const {
  if (kind == FrameOutput::tokens) return {shape[0], shape[1], shape[2] * shape[3] * channels};
  std::vector<int64_t> sizes = shape;
  if (kind == FrameOutput::planes) sizes.insert(sizes.end() - 2, channels);
  if (kind == FrameOutput::bytes && has_axis) sizes.push_back(channels);
  return sizes;
}

void FrameSampler::check(const Frame& frame) const {
  if (frame.height != height || frame.width != width) {
    throw std::invalid_argument("frame must be of the plan's size, (H, W) = " +
                                shown(height, width) + ", got " + shown(frame.height, frame.width));
  }
  const bool known = frame.channels == 1 || frame.channels == 3;
  if (!known || (scale.size() > 1 && frame.channels != static_cast<int64_t>(scale.size()))) {
    throw std::invalid_argument("frame must have the plan's " + std::to_string(scale.size()) +
                                " channels, got " + std::to_string(frame.channels));
  }
  const auto span = [](int64_t size, int64_t stride) {
    return static_cast<double>(size - 1) * std::abs(static_cast<double>(stride));
  };
  if (span(height, frame.row_stride) + span(width, frame.column_stride) >= INT32_MAX) {
    throw std::invalid_argument("frame must span less than 2 GB of memory");
  }
}

ByteImage FrameSampler::image_of(const Frame& frame, float* scales, float* offsets) const {
  for (int c = 0; c < 3; ++c) {  // bytes are not normalized
    const size_t at = scale.size() > 1 ? c : 0;
    scales[c] = makes_bytes() ? 1 : scale[at];
    offsets[c] = makes_bytes() ? 0 : offset[at];
  }
  return {.pixels = frame.pixels,
          .height = height,
          .width = width,
          .channels = frame.channels,
          .row_stride = height > 1 ? frame.row_stride : 0,
          .column_stride = width > 1 ? frame.column_stride : 0,
          .channel_stride = frame.channels > 1 ? frame.channel_stride : 0,
          .scale = scales,
          .offset = offsets};
}

void FrameSampler::sample(const Frame& frame, void* out) const {
  float scales[3], offsets[3];
  FrameArgs a{};
  a.image = image_of(frame, scales, offsets);
  a.columns = columns.data(), a.rows = rows.data();
  a.right = right.data(), a.lower = lower.data();
  a.points = static_cast<int64_t>(columns.size()) - kFrameSpare;
  const int64_t pictures = kind != FrameOutput::tokens && shape.size() == 3 ? shape[0] : 1;
  a.reads = reads, a.pixels = a.points / reads / std::max<int64_t>(pictures, 1);
  a.border = border.data(), a.border_points = static_cast<int64_t>(border.size());
  a.output = kind;
  a.out = out;
  const auto& kernel = kernels<FrameKernels>();
  parallel_ranges(
      a.points / reads, threads_for(static_cast<double>(a.points) / kPerMicrosecond),
      [&](int64_t begin, int64_t end) { kernel.sample(a, begin * reads, end * reads); });
}

void FrameSampler::normalize(const Frame& frame, float* out) const {
  float scales[3], offsets[3];
  const ByteImage image = image_of(frame, scales, offsets);
  const int64_t numbers = width * image.channels;
  const auto rows_of = [&](int64_t begin, int64_t end) {
    for (int64_t y = begin; y < end; ++y) {
      for (int64_t c = 0; c < image.channels; ++c) {
        const uint8_t* from = image.pixels + y * image.row_stride + c * image.channel_stride;
        float* to = out + y * numbers + c;
        for (int64_t x = 0; x < width; ++x) {
          to[x * image.channels] = from[x * image.column_stride] * scales[c] + offsets[c];
        }
      }
    }
  };
  parallel_ranges(height, threads_for(static_cast<double>(height) * numbers / kPerMicrosecond),
                  rows_of);
}

}  // namespace darswin
