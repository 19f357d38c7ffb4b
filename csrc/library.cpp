// The table of contents of libdarswin.so: the schemas of the operators, and facts about the build
// of the module. The drivers register the CPU implementations. Fake kernels and autograd are in
// darswin/ops.
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <string>

#include "core/dispatch.h"
#include "core/parallel.h"

// The arguments that polar_sample and its backward share. Their order is that of the fields of
// struct Sampling (polar_sample.cpp) and of darswin.ops._sampling.Sampling.
#define SAMPLING                                                                                  \
  "Tensor image, Tensor radii, Tensor azimuths, Tensor center, Tensor? affine, Tensor? offsets, " \
  "Tensor? jitter, Tensor? seed, int[] samples, float[] mean, float[] std, bool bfloat16"

#define POLAR_TO_IMAGE                                                                      \
  "Tensor x, Tensor radii, Tensor? center, Tensor? affine, Tensor? points, Tensor? r_max, " \
  "int[] size"

#define MLP "Tensor x, Tensor weight1, Tensor bias1, Tensor weight2, Tensor bias2"

// A backward takes the arguments of its operator, then the gradient of the output.
STABLE_TORCH_LIBRARY(darswin, m) {
  m.def("polar_sample(" SAMPLING ", bool tokens) -> Tensor");
  m.def("polar_sample_backward(" SAMPLING
        ", bool tokens, Tensor grad_out, bool image_grad, bool lens_grad, bool offsets_grad) -> "
        "(Tensor, Tensor, Tensor, Tensor, Tensor)");
  m.def(
      "window_attention(Tensor qkv, Tensor bias, int[] window, int[] shift, int[] periodic, "
      "float scale) -> Tensor");
  m.def(
      "window_attention_backward(Tensor qkv, Tensor bias, int[] window, int[] shift, "
      "int[] periodic, float scale, Tensor grad_out) -> (Tensor, Tensor)");
  m.def("_polar_to_image_plan(" POLAR_TO_IMAGE ") -> Tensor");
  m.def("polar_to_image(" POLAR_TO_IMAGE ", bool tokens, Tensor? plan) -> Tensor");
  m.def("polar_to_image_backward(" POLAR_TO_IMAGE
        ", bool tokens, Tensor? plan, Tensor grad_out, bool x_grad, bool lens_grad) -> "
        "(Tensor, Tensor, Tensor, Tensor, Tensor)");
  m.def("linear(Tensor x, Tensor weight, Tensor? bias) -> Tensor");
  m.def(
      "linear_backward(Tensor x, Tensor weight, Tensor? bias, Tensor grad_out, bool x_grad, "
      "bool weight_grad, bool bias_grad) -> (Tensor, Tensor, Tensor)");
  m.def("mlp(" MLP ") -> (Tensor, Tensor)");  // the second is kept for the backward
  m.def("mlp_backward(" MLP
        ", Tensor hidden, Tensor grad_out) -> (Tensor, Tensor, Tensor, Tensor, Tensor)");
  m.def(
      "_pack_linear(Tensor weight, Tensor? bias, Tensor? weight_scale=None, float scale=1.0, "
      "int zero_point=0) -> Tensor");
  m.def("_norm(Tensor x, Tensor parameters, float eps) -> Tensor");
  m.def(
      "_linear(Tensor x, Tensor packed, int columns, bool gelu, Tensor? norm=None, "
      "float eps=1e-05) -> Tensor");
  m.def("_network(Tensor weights, int[] program) -> int");
  m.def("_forget_network(int network) -> ()");
  m.def("_run(Tensor[] inputs, int network) -> Tensor[]");
}

namespace {

[[maybe_unused]] const auto as_torch =
    darswin::thread_setting = [] { return static_cast<int64_t>(torch::stable::get_num_threads()); };

[[maybe_unused]] const auto with_torch = darswin::torch_ranges =
    [](int64_t count, int64_t threads, darswin::RangeBody body, void* context) {
      torch::stable::parallel_for(0, count, (count + threads - 1) / threads,
                                  [&](int64_t begin, int64_t end) { body(context, begin, end); });
    };

}  // namespace

// Facts about the module, which darswin/ops/_module.py reads.
#define FACT extern "C" __attribute__((visibility("default")))

// The instruction-set tier in use.
FACT const char* darswin_tier() { return darswin::tier_name(darswin::current_tier()); }

// The tiers that this CPU and this build offer, from low to high. A space follows each name.
FACT const char* darswin_tiers() {
  static const std::string names = [] {
    std::string joined;
    for (const darswin::Tier tier : darswin::available_tiers()) {
      joined.append(darswin::tier_name(tier)).push_back(' ');
    }
    return joined;
  }();
  return names.c_str();
}

// Runs the operators on another tier from now on. Returns false if that tier is not offered.
FACT bool darswin_set_tier(const char* name) { return darswin::set_tier(name); }

// Returns the way of 8-bit products: 0 pairs, 1 fours, 2 tiles. `most` limits it first, unless it
// is negative. The results are the same.
FACT int darswin_byte_products(int most) {
  if (most >= 0) darswin::limit_byte_products(static_cast<darswin::ByteProducts>(most));
  return static_cast<int>(darswin::byte_products());
}

FACT bool darswin_cpu_is_intel() { return darswin::cpu_is_intel(); }

// Says whether calls of this thread use the threads of torch, as the backwards do by themselves.
FACT void darswin_use_torch_threads(bool use) { darswin::TorchThreads::set(use); }

#if defined(__clang__)
#  define COMPILER "clang++ " __clang_version__
#else
#  define COMPILER "g++ " __VERSION__
#endif

// The compiler, the C++ standard and the torch ABI of this build, as JSON.
FACT const char* darswin_build_info() {
  static const std::string info = R"({"compiler": ")" COMPILER R"(", "cxx_standard": )" +
                                  std::to_string(__cplusplus) +
                                  R"(, "torch_abi": "stable, torch>=2.10"})";
  return info.c_str();
}
