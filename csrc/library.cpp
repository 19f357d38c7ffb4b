// Table of contents of darswin._C: the operators' schemas, and the module's build facts.
// The CPU implementations are registered in their drivers; fake kernels and autograd are in
// darswin/ops.
#include <pybind11/pybind11.h>
#include <torch/csrc/stable/library.h>

#include <stdexcept>
#include <string>

#include "dispatch.h"

// The arguments that polar_sample and polar_embed share, in the order of the fields of struct
// Sampling (polar_call.h) and of darswin.ops._sampling.Sampling.
#define SAMPLING                                                                                  \
  "Tensor image, Tensor radii, Tensor azimuths, Tensor center, Tensor? affine, Tensor? offsets, " \
  "Tensor? jitter, Tensor? seed, int[] samples, float[] mean, float[] std, bool bfloat16"

#define POLAR_TO_IMAGE                                                                      \
  "Tensor x, Tensor radii, Tensor? center, Tensor? affine, Tensor? points, Tensor? r_max, " \
  "int[] size, bool tokens"

// A backward takes what its operator takes, then the gradient of the output.
STABLE_TORCH_LIBRARY(darswin, m) {
  m.def("polar_sample(" SAMPLING ", bool tokens) -> Tensor");
  m.def("polar_sample_backward(" SAMPLING
        ", bool tokens, Tensor grad_out, bool image_grad, bool lens_grad, bool offsets_grad) -> "
        "(Tensor, Tensor, Tensor, Tensor, Tensor)");
  m.def("polar_embed(" SAMPLING ", Tensor weight, Tensor? bias) -> Tensor");
  m.def("polar_embed_backward(" SAMPLING
        ", Tensor weight, Tensor grad_out, bool image_grad, bool lens_grad, bool offsets_grad, "
        "bool weight_grad) -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
  m.def(
      "window_attention(Tensor qkv, Tensor bias, int[] window, int[] shift, int[] periodic, "
      "float scale) -> Tensor");
  m.def(
      "window_attention_backward(Tensor qkv, Tensor bias, int[] window, int[] shift, "
      "int[] periodic, float scale, Tensor grad_out) -> (Tensor, Tensor)");
  m.def("polar_to_image(" POLAR_TO_IMAGE ") -> Tensor");
  m.def("polar_to_image_backward(" POLAR_TO_IMAGE
        ", Tensor grad_out, bool x_grad, bool lens_grad) -> "
        "(Tensor, Tensor, Tensor, Tensor, Tensor)");
  m.def("_add_norm_(Tensor(a!) x, Tensor(b!) y, Tensor weight, Tensor bias, float eps) -> ()");
  m.def("_transpose_sum(Tensor x) -> (Tensor, Tensor)");
}

PYBIND11_MODULE(_C, m) {
  m.doc() = "Compiled operators of darswin and the instruction-set tier they run on.";
  m.def(
      "tier", [] { return std::string(darswin::tier_name(darswin::current_tier())); },
      "The instruction-set tier in use: 'generic', 'avx2' or 'avx512'.");
  m.def(
      "tiers",
      [] {
        pybind11::list available;
        for (const darswin::Tier tier : darswin::available_tiers()) {
          available.append(darswin::tier_name(tier));
        }
        return available;
      },
      "The tiers that this CPU and this build offer, from low to high.");
  m.def(
      "set_tier",
      [](const std::string& tier) {
        if (!darswin::set_tier(tier.c_str())) {
          throw pybind11::value_error(
              "tier must be one that this CPU and build offer (best: '" +
              std::string(darswin::tier_name(darswin::available_tiers().back())) + "'), got '" +
              tier + "'");
        }
      },
      pybind11::arg("tier"),
      "Runs the operators on another tier from now on. Raises ValueError if the CPU lacks it.");
  m.def(
      "build_info",
      [] {
        pybind11::dict info;
        info["compiler"] = "g++ " __VERSION__;
        info["cxx_standard"] = static_cast<int64_t>(__cplusplus);
        info["openmp"] = _OPENMP;
        info["torch_abi"] = "stable, torch>=2.10";
        return info;
      },
      "What this module was built with.");
}
