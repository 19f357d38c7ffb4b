// polar_to_image and its backward on CPU: check, allocate, thread, call the kernel.
#include "polar_to_image.h"

#include <limits>
#include <tuple>
#include <vector>

#include "checks.h"
#include "core/to_image.h"

namespace darswin {
namespace {

constexpr char kName[] = "polar_to_image";

// The arguments of one call, as the kernels take them. This object owns the memory that `args`
// points into.
template <typename T>
struct ToImageCall {
  using Real = Arithmetic<T>;

  Tensor x, radii;
  MaybeTensor center, affine, points, r_max, plan;
  std::vector<double> plane;
  PolarToImageArgs<T> args{};

  ToImageCall(const Tensor& x_, const Tensor& radii_, const MaybeTensor& center_,
              const MaybeTensor& affine_, const MaybeTensor& points_, const MaybeTensor& r_max_,
              const Sizes& size, bool tokens, const MaybeTensor& plan_)
      : x(as_contiguous(x_)),
        radii(as_contiguous(radii_)),
        center(as_contiguous(center_)),
        affine(as_contiguous(affine_)),
        points(as_contiguous(points_)),
        r_max(as_contiguous(r_max_)),
        plan(as_contiguous(plan_)) {
    STD_TORCH_CHECK(x.dim() == 4 && x.size(1) > 0 && x.size(2) > 0 && size.size() == 2 &&
                        size[0] >= 0 && size[1] >= 0,
                    kName, ": x must be (B, R, A, D) and size (H, W)");
    args.batch = x.size(0), args.rings = x.size(1), args.sectors = x.size(2);
    args.channels = x.size(3), args.height = size[0], args.width = size[1], args.tokens = tokens;
    check_product({args.batch, args.height, args.width, args.channels});
    check_product({args.batch, args.height, args.rings + kSums});
    check_product({args.batch, args.height, args.width, kPosition});
    constexpr int64_t kMostRings = 1 << 24;  // float32 holds the numbers of so many rings
    STD_TORCH_CHECK(args.rings <= std::min(INT32_MAX / args.sectors, kMostRings), kName,
                    ": too many tokens");
    check_product({args.rings, args.sectors, std::max(args.channels, kChannelBlock)});
    STD_TORCH_CHECK(center.has_value() != points.has_value() && !(points && affine), kName,
                    ": takes center, and affine if need be, or else points");
    args.radii_rows = rows(radii, {args.rings});
    args.place_rows = center ? rows(*center, {2}) : rows(*points, {size[0], size[1], 2});
    args.r_max_rows = r_max ? rows(*r_max, {}) : 1;
    args.x = pointer<T>(x);
    args.radii = pointer<Real>(radii);
    check_rising();
    args.r_max = r_max ? pointer<Real>(*r_max) : nullptr;
    args.points = points ? pointer<Real>(*points) : nullptr;
    args.plan = plan ? pointer<Real>(*plan) : nullptr;
    if (center) find_plane();
    args.bands = 1;
    const bool shared = args.radii_rows == 1 && args.place_rows == 1;
    args.lenses = shared ? 1 : args.batch;
    const int64_t plans = shared && args.r_max_rows == 1 ? 1 : args.batch;
    args.plans = plan ? rows(*plan, {size[0], kPosition, size[1]}) : plans;
  }

  int64_t rows(const Tensor& tensor, const Sizes& sizes) const {
    return count_rows<Real>(tensor, args.batch, sizes,
                            "radii, center, affine, points, r_max or plan");
  }

  void check_rising() const {
    for (int64_t k = 0; k < args.radii_rows * args.rings; ++k) {
      const Real r = args.radii[k];
      const bool rises = k % args.rings == 0 || r > args.radii[k - 1];
      STD_TORCH_CHECK(r >= 0 && r < std::numeric_limits<Real>::infinity() && rises, kName,
                      ": radii must be finite, at least 0, and rise from ring to ring");
    }
  }

  // Stores the centres and the inverse matrices. The inverse of a singular matrix has no finite
  // values.
  void find_plane() {
    const int64_t matrices = affine ? rows(*affine, {2, 2}) : 1;
    const Real *c = pointer<Real>(*center), *m = affine ? pointer<Real>(*affine) : nullptr;
    if (args.place_rows == 1) args.place_rows = matrices;
    for (int64_t n = 0; n < args.place_rows; ++n) {
      const Real* at = c + (center->size(0) == 1 ? 0 : 2 * n);
      double xx = 1, xy = 0, yx = 0, yy = 1;
      if (m != nullptr) {
        const Real* of = m + (matrices == 1 ? 0 : 4 * n);
        const double determinant = double{of[0]} * of[3] - double{of[1]} * of[2];
        xx = of[3] / determinant, xy = -of[1] / determinant;
        yx = -of[2] / determinant, yy = of[0] / determinant;
      }
      plane.insert(plane.end(), {at[0], at[1], xx, xy, yx, yy});
    }
    args.plane = plane.data();
  }

  Sizes output_sizes() const {
    if (args.tokens) return {args.batch, args.height, args.width, args.channels};
    return {args.batch, args.channels, args.height, args.width};
  }

  Threads threads() const { return polar_to_image_threads(args); }

  template <typename Kernel>
  void run(int64_t items, Kernel kernel) {
    run_with_scratch(items, threads(), kernels<PolarToImageKernels<T>>().scratch(args),
                     [&](auto... range) { kernel(args, range...); });
  }
};

template <typename T>
Tensor make_plan(ToImageCall<T>&& call) {
  auto& args = call.args;
  const Sizes sizes{args.plans, args.height, kPosition, args.width};
  const Tensor positions = new_tensor(sizes, type_of<Arithmetic<T>>());
  args.positions = mutable_pointer<Arithmetic<T>>(positions);
  call.run(args.plans * args.height, kernels<PolarToImageKernels<T>>().make_plan);
  return positions;
}

template <typename T>
Tensor forward(ToImageCall<T>&& call) {
  auto& args = call.args;
  const Tensor out = new_tensor(call.output_sizes(), call.x.scalar_type());
  if (out.numel() == 0) return out;
  args.out = mutable_pointer<T>(out);
  run_polar_to_image(args);
  return out;
}

// Returns the number of bands into which an image is cut. Bands let few channels of few images use
// all threads too. The number must not depend on the number of threads, because the sums would then
// depend on it.
template <typename T>
int64_t count_bands(const PolarToImageArgs<T>& args) {
  constexpr int64_t kItems = 16;
  const int64_t blocks = units(args.channels, kChannelBlock);
  const int64_t most = args.height * args.width / (4 * args.rings * args.sectors);
  return std::clamp<int64_t>(kItems / (args.batch * blocks), 1, std::max<int64_t>(most, 1));
}

template <typename T>
Tensor map_gradient(ToImageCall<T>& call) {
  auto& args = call.args;
  const auto& kernel = kernels<PolarToImageKernels<T>>();
  const int64_t pixels = args.height * args.width;
  if (call.x.numel() == 0 || pixels == 0) return new_zeros(call.x, call.x.sizes());
  const Tensor grad = new_tensor(call.x.sizes(), call.x.scalar_type());
  args.grad_x = mutable_pointer<T>(grad);
  args.bands = count_bands(args);
  const Tensor partial =
      new_tensor(Sizes{args.bands > 1 ? args.bands * grad.numel() : 0}, type_of<Arithmetic<T>>());
  args.partial = mutable_pointer<Arithmetic<T>>(partial);
  const int64_t blocks = units(args.channels, kChannelBlock);
  call.run(args.batch * args.bands * blocks, kernel.backward_map);
  if (args.bands > 1) {
    parallel_ranges(grad.numel(), call.threads(),
                    [&](auto... range) { kernel.sum_bands(args, range...); });
  }
  return grad;
}

// Returns the gradients of radii, center, affine and points, in this order.
template <typename T>
std::vector<Tensor> lens_gradients(ToImageCall<T>& call) {
  auto& args = call.args;
  const int64_t row = args.rings + kSums;
  std::vector<double> sums(args.lenses * args.height * row, 0.0);
  std::vector<Arithmetic<T>> points(
      args.points == nullptr ? 0 : args.lenses * args.height * args.width * 2);
  args.grad_rows = sums.data();
  args.grad_points = args.points == nullptr ? nullptr : points.data();
  call.run(args.lenses * args.height, kernels<PolarToImageKernels<T>>().backward_lens);

  std::vector<double> lens(args.lenses * row, 0.0);
  for (int64_t item = 0; item < args.lenses * args.height; ++item) {
    for (int64_t k = 0; k < row; ++k) lens[item / args.height * row + k] += sums[item * row + k];
  }
  // Returns the gradient of a tensor. add(lens, its values) adds the part of one lens.
  const auto summed = [&](const MaybeTensor& of, auto add) {
    if (!of) return no_gradient(type_of<Arithmetic<T>>());
    const int64_t values = of->size(0) == 0 ? 0 : of->numel() / of->size(0);
    std::vector<double> total(of->numel(), 0.0);
    for (int64_t n = 0; n < args.lenses && of->size(0) > 0; ++n) {
      add(n, total.data() + (of->size(0) == 1 ? 0 : n * values));
    }
    return rounded_like<Arithmetic<T>>(*of, total);
  };
  const auto on_plane = [&](int64_t n) {
    return args.plane + (args.place_rows == 1 ? 0 : n) * kPlane;
  };
  const auto of_d = [&](int64_t n) { return lens.data() + n * row + args.rings; };
  return {summed(call.radii,
                 [&](int64_t n, double* to) {
                   for (int64_t k = 0; k < args.rings; ++k) to[k] += lens[n * row + k];
                 }),
          // d = M (p - center), so the gradient of the center is -M^T times the gradient of d.
          summed(call.center,
                 [&](int64_t n, double* to) {
                   const double *m = on_plane(n) + 2, *g = of_d(n);
                   to[0] -= m[0] * g[0] + m[2] * g[1];
                   to[1] -= m[1] * g[0] + m[3] * g[1];
                 }),
          // M is the inverse of the matrix, so dA = -M^T (sum of the gradient of d times p -
          // center) M^T.
          summed(call.affine,
                 [&](int64_t n, double* to) {
                   const double *m = on_plane(n) + 2, *g = of_d(n) + 2;
                   const double h[] = {m[0] * g[0] + m[2] * g[2], m[0] * g[1] + m[2] * g[3],
                                       m[1] * g[0] + m[3] * g[2], m[1] * g[1] + m[3] * g[3]};
                   to[0] -= h[0] * m[0] + h[1] * m[1], to[1] -= h[0] * m[2] + h[1] * m[3];
                   to[2] -= h[2] * m[0] + h[3] * m[1], to[3] -= h[2] * m[2] + h[3] * m[3];
                 }),
          summed(call.points, [&](int64_t n, double* to) {
            const int64_t values = args.height * args.width * 2;
            for (int64_t k = 0; k < values; ++k) to[k] += points[n * values + k];
          })};
}

template <typename T>
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> backward(ToImageCall<T>&& call, Tensor grad,
                                                            bool x_grad, bool lens_grad) {
  const TorchThreads in_training;
  grad = checked_gradient(grad, call.output_sizes(), call.x.scalar_type(), kName);
  call.args.grad_out = pointer<T>(grad);
  std::vector<Tensor> lens(4, no_gradient(type_of<Arithmetic<T>>()));
  if (lens_grad) lens = lens_gradients(call);
  const Tensor x = x_grad ? map_gradient(call) : no_gradient(call.x.scalar_type());
  return {x, lens[0], lens[1], lens[2], lens[3]};
}

Tensor polar_to_image_plan(Tensor x, Tensor radii, MaybeTensor center, MaybeTensor affine,
                           MaybeTensor points, MaybeTensor r_max, Sizes size) {
  return with_real_type(x, kName, [&]<typename T>() {
    return make_plan(ToImageCall<T>(x, radii, center, affine, points, r_max, size, false, {}));
  });
}

Tensor polar_to_image(Tensor x, Tensor radii, MaybeTensor center, MaybeTensor affine,
                      MaybeTensor points, MaybeTensor r_max, Sizes size, bool tokens,
                      MaybeTensor plan) {
  return with_real_type(x, kName, [&]<typename T>() {
    return forward(ToImageCall<T>(x, radii, center, affine, points, r_max, size, tokens, plan));
  });
}

auto polar_to_image_backward(Tensor x, Tensor radii, MaybeTensor center, MaybeTensor affine,
                             MaybeTensor points, MaybeTensor r_max, Sizes size, bool tokens,
                             MaybeTensor plan, Tensor grad, bool x_grad, bool lens_grad) {
  return with_real_type(x, kName, [&]<typename T>() {
    return backward(ToImageCall<T>(x, radii, center, affine, points, r_max, size, tokens, plan),
                    grad, x_grad, lens_grad);
  });
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("polar_to_image", TORCH_BOX(&darswin::polar_to_image));
  m.impl("_polar_to_image_plan", TORCH_BOX(&darswin::polar_to_image_plan));
  m.impl("polar_to_image_backward", TORCH_BOX(&darswin::polar_to_image_backward));
}
