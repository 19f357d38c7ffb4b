// Checks a program, once for all its runs.
#include "network.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>
#include <string>
#include <utility>

#include "../polar_to_image.h"

namespace darswin {
namespace {

// The count of arguments of each opcode, in its order.
constexpr std::array<int64_t, 13> kArguments = {9, 5, 23, 19, 2, 4, 2, 8, 7, 8, 8, 2, 5};
constexpr char kTooLarge[] = "wants more memory than its inputs and layers can need";

void require(bool condition, const char* what) {
  if (!condition) throw std::invalid_argument(std::string("the program of a network ") + what);
}

int64_t checked_size(int64_t size) {
  require(size >= 1 && size <= kMostNumbers, "has a size out of range");
  return size;
}

// The product of sizes. Throws if it is too large.
int64_t product(std::initializer_list<int64_t> sizes) {
  int64_t result = 1;
  for (const int64_t size : sizes) {
    require(checked_size(size) <= kMostNumbers / result, "has sizes that are too large");
    result *= size;
  }
  return result;
}

// Whether a number is a function that may follow a product.
bool follows(int64_t after) {
  return after == static_cast<int64_t>(After::gelu) || after == static_cast<int64_t>(After::relu);
}

// Reads a program from front to back.
struct Reader {
  const std::vector<int64_t>& program;
  size_t at = 0;

  int64_t next() {
    require(at < program.size(), "ends too early");
    return program[at++];
  }
  int64_t count() {
    const int64_t value = next();
    require(value >= 0 && value <= kMostSlots, "has a count out of range");
    return value;
  }
  std::vector<int64_t> sizes() {
    std::vector<int64_t> values(count());
    for (int64_t& value : values) value = checked_size(next());
    return values;
  }
};

}  // namespace

Network::Network(std::vector<int64_t> program_, const uint32_t* weights_, int64_t words_)
    : program(std::move(program_)), weights(weights_), words(words_) {
  require(program.size() <= kMostWords, "is too long");
  Reader reader{program};
  inputs = reader.sizes();
  buffers = reader.sizes();
  const int64_t count = reader.count();
  for (int64_t k = 0; k < count; ++k) {
    const int64_t buffer = reader.count();
    std::vector<int64_t> shape = reader.sizes();
    require(buffer < static_cast<int64_t>(buffers.size()), "has an output without a buffer");
    int64_t numbers = 1;
    for (const int64_t size : shape) numbers = product({numbers, size});
    require(numbers == buffers[buffer], "has an output of another size than its buffer");
    for (const Output& other : outputs) {
      require(other.slot != input_count() + buffer, "has two outputs in one buffer");
    }
    outputs.push_back({input_count() + buffer, std::move(shape)});
  }
  while (reader.at < program.size()) {
    const int64_t opcode = reader.next(), arguments = reader.count();
    require(opcode >= 0 && opcode < static_cast<int64_t>(kArguments.size()) &&
                arguments == kArguments[opcode] &&
                arguments <= static_cast<int64_t>(program.size() - reader.at),
            "has an unknown instruction: it may come from a newer version of darswin");
    for (int64_t k = 0; k < arguments; ++k) {  // then no sum or product of two overflows
      const int64_t argument = program[reader.at + k];
      require(argument >= -kMostNumbers && argument <= kMostNumbers, "has a number out of range");
    }
    append(checked(static_cast<Opcode>(opcode), &program[reader.at]));
    reader.at += arguments;
  }
  check_memory();
}

// Throws if a run would take far more memory than such inputs and such layers can need. Maps have
// as many tokens as an input has numbers, or fewer, and tokens are as wide as a layer. The sizes of
// buffers are only claims, and a small file must not claim all memory of a machine.
void Network::check_memory() {
  int64_t tokens = 1, width = 1, most = 0, wanted = 0;
  for (const int64_t numbers : inputs) {
    tokens = std::max(tokens, numbers);
    require((total += numbers) <= kMostNumbers, kTooLarge);
  }
  for (const Step& step : steps) {
    for (const Layer* layer : {&step.layer, &step.block.qkv, &step.block.fc1}) {
      width = std::max(width, layer->columns);
    }
  }
  if (__builtin_mul_overflow(tokens, width, &most)) most = kMostNumbers;
  most = std::clamp(most, kFreeNumbers, kMostNumbers);
  for (const int64_t numbers : buffers) require((wanted += numbers) <= most, kTooLarge);
  total += wanted;
  for (const Step& step : steps) {
    if (step.opcode != Opcode::block) continue;
    const WindowAttentionArgs<float>& map = step.block.windows;
    const int64_t widest = std::max(step.block.qkv.columns, step.block.fc1.columns);
    require(product({map.rings, map.sectors, widest}) <= most, kTooLarge);
  }
}

int64_t Network::numbers(int64_t slot) const {
  return slot < input_count() ? inputs[slot] : buffers[slot - input_count()];
}

// The numbers of a slot. Throws unless it exists, and is a buffer if it is written.
int64_t Network::numbers_at(int64_t slot, bool writes) const {
  require(slot >= (writes ? input_count() : 0) && slot < slots(),
          "names a slot that it does not have");
  return numbers(slot);
}

// Throws unless a slot also has room for these numbers.
void Network::fits(int64_t slot, std::initializer_list<int64_t> sizes, bool writes) const {
  const int64_t held = numbers_at(slot, writes);
  require(product(sizes) == held, "uses a slot of another size");
}

Layer Network::layer_at(int64_t offset, int64_t depth, int64_t columns,
                        int64_t is_quantized) const {
  require(is_quantized == 0 || is_quantized == 1, "has an unknown kind of layer");
  product({depth, columns});
  product({depth + kPanelUnit, columns + kPanelUnit, 4});
  require(is_quantized == 0 || depth <= kMostDepth, "has a sum that does not fit 32 bits");
  const int64_t count = Layer::words(depth, columns, is_quantized == 1);
  return Layer(weights_at(offset, count), depth, columns, is_quantized == 1);
}

const float* Network::weights_at(int64_t offset, int64_t count) const {
  require(offset >= 0 && offset <= words && count <= words - offset, "reads beyond its weights");
  return reinterpret_cast<const float*>(weights) + offset;
}

// The parameters of a norm are its weight and its bias, then its eps.
Norm Network::norm_at(int64_t offset, int64_t dim) const {
  const float* parameters = weights_at(offset, product({dim, 2}) + 1);
  return {parameters, dim, parameters[2 * dim]};
}

Block Network::block_of(const int64_t* a) const {
  const int64_t rings = a[1], sectors = a[2], dim = a[3], heads = a[4], mlp = a[5];
  fits(a[0], {rings, sectors, dim}, true);
  require(heads > 0 && dim > 0 && dim % heads == 0 && mlp > 0, "has a block of wrong sizes");
  product({rings, sectors, std::max(3 * dim, mlp)});
  const int64_t* w = a + 16;  // window, shift, periodic
  for (int axis = 0; axis < 2; ++axis) {
    const int64_t size = a[1 + axis];
    require(
        w[axis] > 0 && size > 0 && size % w[axis] == 0 && w[2 + axis] >= 0 && w[2 + axis] < size,
        "has windows that do not fit their map");
  }
  require(a[22] < input_count(), "has a table that is no input");
  fits(a[22], {heads, 2 * w[0] - 1, 2 * w[1] - 1}, false);
  Block block{.norm1 = norm_at(a[6], dim),
              .norm2 = norm_at(a[11], dim),
              .qkv = layer_at(a[7], dim, 3 * dim, a[8]),
              .proj = layer_at(a[9], dim, dim, a[10]),
              .fc1 = layer_at(a[12], dim, mlp, a[13]),
              .fc2 = layer_at(a[14], mlp, dim, a[15])};
  auto& windows = block.windows;
  windows.rings = rings, windows.sectors = sectors;
  windows.heads = heads, windows.head_dim = dim / heads;
  windows.window_r = w[0], windows.window_a = w[1];
  windows.windows = (rings / w[0]) * (sectors / w[1]);
  windows.shift_r = w[2], windows.shift_a = w[3];
  windows.periodic_r = w[4] != 0, windows.periodic_a = w[5] != 0;
  windows.scale = static_cast<float>(1 / std::sqrt(static_cast<double>(dim / heads)));
  return block;
}

// Appends a step. A convolution does what follows it while its result is in the cache: a function,
// a sum, and a function of that.
void Network::append(Step step) {
  const int64_t* a = step.arguments;
  if (!steps.empty() && steps.back().opcode == Opcode::conv) {
    Step& conv = steps.back();
    const int64_t out = conv.arguments[1];
    After& function = conv.summand < 0 ? conv.after : conv.then;
    if (step.opcode == Opcode::apply && a[0] == out && function == After::nothing) {
      function = static_cast<After>(a[1]);
      return;
    }
    if (step.opcode == Opcode::add && a[1] == out && conv.summand < 0) {
      conv.summand = a[0];
      return;
    }
  }
  steps.push_back(std::move(step));
}

Network::Step Network::checked(Opcode opcode, const int64_t* a) const {
  Step step{opcode, a};
  const auto apart = [&] { require(a[0] != a[1], "writes what it still reads"); };
  switch (opcode) {
    case Opcode::linear:
      apart();
      fits(a[0], {a[2], a[3]}, false);
      fits(a[1], {a[2], a[4]}, true);
      step.layer = layer_at(a[5], a[3], a[4], a[6]);
      require(a[6] == 0 || a[7] >= 0, "has a quantized layer without a norm");
      if (a[7] >= 0) step.norm = norm_at(a[7], a[3]);
      break;
    case Opcode::norm:
      fits(a[0], {a[2], a[3]}, false);
      fits(a[1], {a[2], a[3]}, true);
      step.norm = norm_at(a[4], a[3]);
      break;
    case Opcode::block:
      step.block = block_of(a);
      break;
    case Opcode::copy: {
      apart();
      for (int side = 0; side < 2; ++side) {
        const int64_t *sizes = a + 4, numbers = numbers_at(a[side], side == 1);
        int64_t last = a[2 + side];
        require(last >= 0 && last < numbers, "copies beyond a slot");
        for (int axis = 0; axis < kCopyAxes; ++axis) {
          const int64_t steps = checked_size(sizes[axis]) - 1,
                        stride = sizes[kCopyAxes * (1 + side) + axis];
          require(stride >= 0 && (steps == 0 || stride <= (numbers - 1 - last) / steps),
                  "copies beyond a slot");
          last += steps * stride;
        }
        require(side == 0 || product({a[4], a[5], a[6], a[7], a[8]}) <= numbers,
                "copies to a place twice");
      }
      break;
    }
    case Opcode::add:
      apart();
      fits(a[0], {numbers_at(a[1], true)}, false);
      break;
    case Opcode::mean:
      apart();
      fits(a[0], {a[2], a[3]}, false);
      fits(a[1], {a[3]}, true);
      break;
    case Opcode::apply:
    case Opcode::distance:
      require(opcode == Opcode::distance || follows(a[1]), "has an unknown function");
      numbers_at(a[0], true);
      break;
    case Opcode::conv:
      apart();
      fits(a[0], {a[2], a[3], a[4]}, false);
      fits(a[1], {a[2], a[3], a[5]}, true);
      step.layer = layer_at(a[6], product({a[4], 9}), a[5], 0);
      require(a[7] == 0 || follows(a[7]), "has an unknown function");
      step.after = static_cast<After>(a[7]);
      break;
    case Opcode::pool:
      apart();
      fits(a[0], {a[2], a[3], a[4]}, false);
      fits(a[1], {units(a[2], 2), units(a[3], 2), a[4]}, true);
      break;
    case Opcode::resize:
    case Opcode::sample:
      apart();
      fits(a[0], {a[2], a[3], a[6]}, false);
      fits(a[1], {a[4], a[5], a[6]}, true);
      if (opcode == Opcode::sample) fits(a[7], {a[4], a[5], 2}, false);
      break;
    case Opcode::to_image:
      apart();
      fits(a[0], {a[2], a[3], a[4]}, false);
      fits(a[1], {a[5], a[6], a[4]}, true);
      fits(a[7], {a[5], kPosition, a[6]}, false);
      require(a[7] < input_count(), "has a plan that is no input");
      require(a[2] <= (1 << 24) && product({a[2], a[3]}) <= INT32_MAX, "has too many tokens");
      break;
  }
  return step;
}

}  // namespace darswin
