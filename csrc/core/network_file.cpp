#include "network_file.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <iterator>
#include <stdexcept>

#include "parallel.h"

namespace darswin {
namespace {

void require(bool condition, const char* what) {
  if (!condition) throw std::invalid_argument(what);
}

std::unique_ptr<const FrameSampler> sampler_of(const TensorFile& file) {
  const auto mean = file.numbers<double>("plan.mean"), std = file.numbers<double>("plan.std");
  const auto size = file.numbers<int64_t>("plan.size");
  require(mean.size() == std.size() && size.size() == 2, "its plan does not fit together");
  FramePlan plan{.shape = file.shape("plan.columns"),
                 .columns = file.numbers<int16_t>("plan.columns"),
                 .rows = file.numbers<int16_t>("plan.rows"),
                 .right = file.numbers<float>("plan.right"),
                 .lower = file.numbers<float>("plan.lower"),
                 .height = size[0],
                 .width = size[1],
                 .scale = {},
                 .offset = {},
                 .output = file.text("plan.output"),
                 .reads = file.number<int64_t>("plan.supersampling")};
  for (size_t c = 0; c < mean.size(); ++c) {
    plan.scale.push_back(static_cast<float>(1 / (255 * std[c])));
    plan.offset.push_back(static_cast<float>(-mean[c] / std[c]));
  }
  require(!plan.columns.empty() && plan.output != "uint8", "its plan does not fit the network");
  return std::make_unique<const FrameSampler>(plan);
}

int64_t product(const std::vector<int64_t>& sizes) {
  int64_t result = 1;
  for (const int64_t size : sizes) result *= size;
  return result;
}

void softmax(float* x, int64_t count) {
  const float largest = *std::max_element(x, x + count);
  double sum = 0;
  for (int64_t k = 0; k < count; ++k) sum += x[k] = std::exp(x[k] - largest);
  for (int64_t k = 0; k < count; ++k) x[k] = static_cast<float>(x[k] / sum);
}

}  // namespace

FrameNetwork::FrameNetwork(const std::string& path) try : file(path) {
  const std::string& version = file.text("darswin_network");
  int64_t major = -1;
  std::from_chars(version.data(), version.data() + version.size(), major);
  require(major >= 0, "its version is damaged");
  require(major <= kFileVersion[0], "it comes from a newer version of darswin: update darswin");
  require(major == kFileVersion[0],
          "it comes from an older version of darswin: export the network again");
  size = file.numbers<int64_t>("plan.size");
  sampler = sampler_of(file);
  const auto program = file.numbers<int64_t>("program");
  const auto weights = file.numbers<int32_t>("weights");
  network = std::make_unique<const Network>(std::vector<int64_t>(program.begin(), program.end()),
                                            reinterpret_cast<const uint32_t*>(weights.data()),
                                            static_cast<int64_t>(weights.size()));
  while (const auto* label = file.find_text("label." + std::to_string(names.size()))) {
    names.push_back(*label);
  }

  const std::string& finish = file.text("finish");
  const std::string known[] = {"probabilities", "array", "list"};
  const auto* found = std::find(std::begin(known), std::end(known), finish);
  require(found != std::end(known), "it finishes its outputs in a way that is not known");
  how = static_cast<Finish>(found - known);
  const int64_t count = network->input_count(), outputs = network->output_count();
  require(count > 0 && outputs > 0 && (outputs == 1 || how == Finish::list),
          "its inputs or outputs do not fit");
  const bool classifies = how == Finish::probabilities;
  require(!classifies || (output_shape(0).size() == 1 && output_shape(0)[0] > 0),
          "its probabilities have a wrong shape");
  require(names.empty() || (!output_shape(0).empty() &&
                            static_cast<int64_t>(names.size()) == output_shape(0)[0]),
          "it has not a label for each class");

  const int64_t points = product(sampler->output_shape(1));
  colors = network->input_numbers(0) / points;
  require((colors == 1 || colors == 3) && network->input_numbers(0) == colors * points,
          "its plan does not fit the network");
  const int64_t reads = file.number<int64_t>("reads_frame");
  reads_frame = reads == 1;
  require(reads_frame || reads == 0, "its inputs do not fit");
  require(!reads_frame || (count > 1 && network->input_numbers(1) == height() * width() * colors),
          "its inputs do not fit");
  inputs.resize(count, {nullptr, 1});
  auto constants = file.numbers<float>("constants");
  for (int64_t k = reads_frame ? 2 : 1; k < count; ++k) {
    const auto numbers = static_cast<size_t>(network->input_numbers(k));
    require(numbers <= constants.size(), "its inputs do not fit");
    inputs[k].data = constants.data();
    constants = constants.subspan(numbers);
  }
  require(constants.empty(), "its inputs do not fit");
} catch (const std::invalid_argument& error) {
  throw std::invalid_argument(path +
                              " is no network that darswin.frames can read: " + error.what());
}

void FrameNetwork::check(const Frame& frame) const {
  if (frame.channels != colors) {
    throw std::invalid_argument("frame must have the network's " + std::to_string(colors) +
                                " channels, got " + std::to_string(frame.channels));
  }
  sampler->check(frame);
}

void FrameNetwork::run(const Frame& frame, float* const* outputs) const {
  std::vector<Input> given = inputs;
  const int64_t sampled = round_up(network->input_numbers(0), 16);
  const int64_t whole = reads_frame ? network->input_numbers(1) : 0;
  // Fresh pages would cost more than the sampling. The network uses kinds 1 and 2.
  const ThreadMemoryOf<3> memory((sampled + whole) * sizeof(float));
  auto* numbers = static_cast<float*>(memory.get());
  given[0].data = numbers;
  sampler->sample(frame, numbers);
  if (reads_frame) {
    given[1].data = numbers + sampled;
    sampler->normalize(frame, numbers + sampled);
  }
  network->run(1, given.data(), outputs);
  if (how == Finish::probabilities) softmax(outputs[0], output_shape(0)[0]);
}

}  // namespace darswin
