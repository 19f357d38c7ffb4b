// The forward of a network: a program of layers on flat weights. Operators of torch and
// darswin.frames run it. darswin/deploy/program.py writes programs.
//
// A program is an array of int64. First come the inputs, the buffers and the outputs:
//   count of inputs, then the numbers of each input for one image;
//   count of buffers, then the numbers of each buffer for one image;
//   count of outputs, then for each its buffer, its count of axes, and its shape without the batch.
// The instructions follow: an opcode, the count of its arguments, and its arguments. Arguments that
// name numbers are slots: 0, 1, ... are the inputs, and the buffers follow them. Arguments that
// name weights are offsets in words of 32 bits. All maps are channels last.
#pragma once

#include <cstdint>
#include <vector>

#include "layers.h"

namespace darswin {

enum class Opcode : int64_t {
  linear,    // x, out, rows, depth, columns, layer, is quantized, norm or -1, gelu (0 or 1)
  norm,      // x, out, rows, dim, norm; out may be x
  block,     // x, R, A, dim, heads, mlp dim, norm1, qkv, proj, norm2, fc1, fc2 (each layer with its
             // flag: is quantized), window (2), shift (2), periodic (2), table
  copy,      // x, out, offset in x, offset in out, sizes (5), strides in x (5), strides in out (5)
  add,       // x, out: out += x
  mean,      // x, out, rows, dim: over the rows
  apply,     // x, in place, the function: gelu or relu (After)
  conv,      // x, out, H, W, channels, columns, layer, what follows: nothing, gelu or relu (After);
             // 3 x 3, with zeros around the map
  resize,    // x, out, H, W, H', W', channels: bilinear, pixel centres at half
  sample,    // x, out, H, W, H', W', channels, points (H', W', 2): bilinear, zeros outside
  to_image,  // x, out, R, A, channels, H, W, plan: polar_to_image
  distance,  // x, in place, typical distance as the bits of a float
  pool,      // x, out, H, W, channels: the largest of 2 x 2 pixels, also of fewer at the ends
};

constexpr int64_t kCopyAxes = 5;
// All sizes are at least 1, so that no instruction takes more steps than its slots have numbers.
constexpr int64_t kMostNumbers = int64_t{1} << 40;  // of a program, and of the slots of a run
constexpr int64_t kMostSlots = 1 << 14;             // of a kind
constexpr int64_t kMostWords = 1 << 18;             // of a program
// A program may always have buffers of so many numbers for an image, 64 MB. More than that must
// follow from its inputs and its layers.
constexpr int64_t kFreeNumbers = int64_t{1} << 24;

// The numbers of an input: (rows, numbers of one image) with a row for each image or one for all.
struct Input {
  const float* data;
  int64_t rows;
};

class Network {
 public:
  // The weights must outlive the network. Throws std::invalid_argument if the program is wrong: no
  // run of the network reads or writes beyond its numbers.
  Network(std::vector<int64_t> program, const uint32_t* weights, int64_t words);

  int64_t input_count() const { return static_cast<int64_t>(inputs.size()); }
  int64_t input_numbers(int64_t k) const { return inputs[k]; }
  int64_t output_count() const { return static_cast<int64_t>(outputs.size()); }
  // The shape of an output for one image.
  const std::vector<int64_t>& output_shape(int64_t k) const { return outputs[k].shape; }

  // Computes the outputs (batch, shape) for all images. Several threads may call it at once. Throws
  // std::invalid_argument if an input has a wrong number of rows.
  void run(int64_t batch, const Input* given, float* const* results) const;

 private:
  struct Output {
    int64_t slot;
    std::vector<int64_t> shape;
  };
  struct Step {
    Opcode opcode;
    const int64_t* arguments;
    Norm norm{};
    Layer layer{};
    Block block{};
    // A convolution applies a function, adds this slot, if any, and applies a function to the sum.
    After after = After::nothing, then = After::nothing;
    int64_t summand = -1;
  };
  struct Run;

  Step checked(Opcode opcode, const int64_t* arguments) const;
  void append(Step step);
  Layer layer_at(int64_t offset, int64_t depth, int64_t columns, int64_t is_quantized) const;
  Norm norm_at(int64_t offset, int64_t dim) const;
  const float* weights_at(int64_t offset, int64_t count) const;
  Block block_of(const int64_t* arguments) const;
  int64_t slots() const { return input_count() + static_cast<int64_t>(buffers.size()); }
  int64_t numbers(int64_t slot) const;  // for one image
  int64_t numbers_at(int64_t slot, bool writes) const;
  void fits(int64_t slot, std::initializer_list<int64_t> sizes, bool writes) const;
  void check_memory();

  std::vector<int64_t> program;
  const uint32_t* weights;
  int64_t words;
  std::vector<int64_t> inputs, buffers;
  int64_t total = 1;  // at least the numbers of all slots, for one image
  std::vector<Output> outputs;
  std::vector<Step> steps;
};

}  // namespace darswin
