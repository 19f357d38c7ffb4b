// A whole network, or a part of one, as one operator on CPU: `_run`. core/network.h describes its
// programs. For a small network, the Python calls of its layers take longer than their arithmetic.
//
// `_network` checks a program once, and returns the number by which `_run` finds it until it is
// forgotten. No lock protects the numbers: a process may fork while another thread runs a network.
#include <atomic>
#include <memory>
#include <stdexcept>
#include <vector>

#include "checks.h"
#include "core/network.h"

namespace darswin {
namespace {

struct Known {
  Tensor weights;  // which the network reads
  Network network;
};

constexpr int64_t kMost = 1 << 16;
std::atomic<const Known*> known[kMost];

int64_t make_network(Tensor weights, Sizes program) {
  STD_TORCH_CHECK(
      weights.is_cpu() && weights.scalar_type() == ScalarType::Int && weights.is_contiguous(),
      "_network: the weights must be contiguous int32");
  const auto* words = pointer<uint32_t>(weights);
  auto made = std::make_unique<const Known>(
      Known{weights, Network(std::move(program), words, weights.numel())});
  for (int64_t number = 0; number < kMost; ++number) {
    const Known* none = nullptr;
    if (known[number].compare_exchange_strong(none, made.get())) {
      made.release();
      return number;
    }
  }
  throw std::runtime_error("_network: there are too many networks");
}

// No run of the network may be under way.
void forget(int64_t number) {
  if (number >= 0 && number < kMost) delete known[number].exchange(nullptr);
}

std::vector<Tensor> run(std::vector<Tensor> inputs, int64_t number) {
  const Known* const found = number >= 0 && number < kMost ? known[number].load() : nullptr;
  STD_TORCH_CHECK(found != nullptr, "_run: there is no such network");
  const Network& network = found->network;
  STD_TORCH_CHECK(!inputs.empty() && inputs[0].dim() > 0, "_run: the first input must be (B, ...)");
  const int64_t batch = inputs[0].size(0);
  STD_TORCH_CHECK(network.input_count() == static_cast<int64_t>(inputs.size()),
                  "_run: the program has another number of inputs");
  std::vector<Input> given;
  for (size_t k = 0; k < inputs.size(); ++k) {
    Tensor& x = inputs[k];
    STD_TORCH_CHECK(x.is_cpu() && x.scalar_type() == ScalarType::Float && x.dim() > 0 &&
                        (x.size(0) == 1 || x.size(0) == batch) &&
                        x.numel() == x.size(0) * network.input_numbers(k),
                    "_run: an input has a wrong type, device or shape");
    x = as_contiguous(x);
    given.push_back({pointer<float>(x), x.size(0)});
  }
  std::vector<Tensor> outputs;
  std::vector<float*> results;
  for (int64_t k = 0; k < network.output_count(); ++k) {
    Sizes sizes = network.output_shape(k);
    sizes.insert(sizes.begin(), batch);
    outputs.push_back(new_tensor(sizes, ScalarType::Float));
    results.push_back(mutable_pointer<float>(outputs.back()));
  }
  network.run(batch, given.data(), results.data());
  return outputs;
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("_network", TORCH_BOX(&darswin::make_network));
  m.impl("_forget_network", TORCH_BOX(&darswin::forget));
  m.impl("_run", TORCH_BOX(&darswin::run));
}
