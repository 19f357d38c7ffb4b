// A network for the frames of one camera, from a file of darswin.deploy.camera.export_network.
// docs/reference/files.md describes the file.
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "frame.h"
#include "network.h"
#include "tensor_file.h"

namespace darswin {

// {major, minor}. Files of another major version are refused. A minor version only adds arrays that
// older libraries need not read.
inline constexpr int64_t kFileVersion[] = {2, 0};

class FrameNetwork {
 public:
  enum class Finish {
    probabilities,  // the one output is logits, and its softmax is the result
    array,          // the one output is the result
    list,           // the result is a list of all outputs
  };

  // Throws std::invalid_argument if the file is damaged or of another version, and
  // std::system_error if it cannot be read.
  explicit FrameNetwork(const std::string& path);
  FrameNetwork(const FrameNetwork&) = delete;

  int64_t height() const { return size[0]; }
  int64_t width() const { return size[1]; }
  int64_t channels() const { return colors; }  // of a frame
  Finish finish() const { return how; }
  int64_t output_count() const { return network->output_count(); }
  const std::vector<int64_t>& output_shape(int64_t k) const { return network->output_shape(k); }
  const std::vector<std::string>& labels() const { return names; }

  // Throws std::invalid_argument if a frame does not fit.
  void check(const Frame& frame) const;
  // Computes the outputs of a checked frame, on at most num_threads() threads. Several threads may
  // call it at once.
  void run(const Frame& frame, float* const* outputs) const;

 private:
  const TensorFile file;  // the network reads its weights here
  std::span<const int64_t> size;
  std::unique_ptr<const FrameSampler> sampler;
  std::unique_ptr<const Network> network;
  std::vector<Input> inputs;  // without data where a frame is read
  bool reads_frame;
  int64_t colors;
  Finish how;
  std::vector<std::string> names;
};

}  // namespace darswin
