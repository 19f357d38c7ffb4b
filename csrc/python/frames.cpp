// The Python module darswin.frames._frames: NumPy arrays in, NumPy arrays out. It does not use
// torch.
#include "../frames.h"

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "../core/dispatch.h"
#include "../core/parallel.h"

// glibc 2.34 gave the same function a new version (see portable.cpp).
#if defined(__GLIBC__) && defined(__x86_64__)
__asm__(".symver pthread_once, pthread_once@GLIBC_2.2.5");
#elif defined(__GLIBC__) && defined(__aarch64__)
__asm__(".symver pthread_once, pthread_once@GLIBC_2.17");
#endif

namespace py = pybind11;

namespace darswin {
namespace {

constexpr int64_t kMostReads = 16;  // along a side of a pixel: all points fit one block

template <typename T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;
using Shape = std::vector<py::ssize_t>;

std::string shown(const Shape& shape) {
  std::string text = "(";
  for (const py::ssize_t size : shape) text += std::to_string(size) + ", ";
  return text.substr(0, std::max<size_t>(text.size(), 3) - 2) + ")";
}

// NumPy's answer is exact. Where it would take more than milliseconds, which needs strange strides,
// NumPy gives up, and the arrays count as sharing memory.
bool share_memory(const py::array& one, const py::array& other) {
  constexpr int64_t kMostWork = 100'000;
  try {
    const py::object shares = py::module_::import("numpy").attr("shares_memory");
    return shares(one, other, py::arg("max_work") = kMostWork).cast<bool>();
  } catch (const py::error_already_set& error) {
    if (!error.matches(PyExc_RuntimeError)) throw;  // the base of NumPy's TooHardError
    return true;
  }
}

template <typename T>
std::vector<T> padded(const Array<T>& array) {
  std::vector<T> values(array.data(), array.data() + array.size());
  values.resize(values.size() + kFrameSpare);
  return values;
}

// Samples frames of one size at the places of one plan. A call changes nothing in the object, so
// several threads may call it at once.
class Sampler {
 public:
  Sampler(const Array<int16_t>& columns, const Array<int16_t>& rows, const Array<float>& right,
          const Array<float>& lower, std::pair<int64_t, int64_t> size, std::vector<float> scale,
          std::vector<float> offset, const std::string& output, int64_t reads)
      : reads(reads * reads),
        shape(columns.shape(), columns.shape() + columns.ndim() - (reads > 1)),
        columns(padded(columns)),
        rows(padded(rows)),
        right(padded(right)),
        lower(padded(lower)),
        height(size.first),
        width(size.second),
        scale(std::move(scale)),
        offset(std::move(offset)) {
    const int64_t points = columns.size();
    const bool tokens = output == "tokens",
               known = tokens || output == "image" || output == "uint8";
    const bool sizes = height > 0 && width > 0 && height <= INT16_MAX && width <= INT16_MAX;
    const bool channels = this->scale.size() == 1 || this->scale.size() == 3;
    const bool axes =
        tokens ? shape.size() == 4 && reads == 1 : shape.size() == 2 || shape.size() == 3;
    if (!known || !sizes || !channels || this->scale.size() != this->offset.size() || reads < 1 ||
        reads > kMostReads || !axes || (reads > 1 && columns.shape(shape.size()) != this->reads) ||
        rows.size() != points || right.size() != points || lower.size() != points) {
      throw py::value_error("the parts of the plan do not fit together");
    }
    kind = tokens              ? FrameOutput::tokens
           : output == "image" ? FrameOutput::planes
                               : FrameOutput::bytes;
    for (int64_t k = 0; k < points; ++k) {
      const float x = this->right[k], y = this->lower[k];
      if (!(x >= 0 && x <= 1 && y >= 0 && y <= 1)) {
        throw py::value_error("the plan has distances outside of [0, 1]");
      }
    }
    for (int64_t first = 0; first < points; first += this->reads) {
      bool inside = true;
      for (int64_t k = first; k < first + this->reads; ++k) {
        inside &= this->columns[k] >= 0 && this->rows[k] >= 0 && this->columns[k] < width - 1 &&
                  this->rows[k] < height - 1;
      }
      for (int64_t k = first; k < first + this->reads && !inside; ++k) {
        int16_t &column = this->columns[k], &row = this->rows[k];
        border.push_back({k, column, row, this->right[k], this->lower[k]});
        column = row = 0;
      }
    }
  }

  py::array operator()(const py::object& given, const py::object& out, int64_t threads) const {
    if (!py::isinstance<py::array_t<uint8_t>>(given)) {
      throw py::type_error("frame must be a NumPy array of uint8, got " +
                           std::string(py::isinstance<py::array>(given)
                                           ? py::str(given.attr("dtype"))
                                           : py::str(py::type::of(given))));
    }
    const auto frame = py::reinterpret_borrow<py::array>(given);
    if (threads < 1) throw py::value_error("threads must be at least 1");
    const Shape sizes(frame.shape(), frame.shape() + frame.ndim());
    const bool colors = sizes.size() == 3;
    FrameArgs a{};
    ByteImage& image = a.image;
    image.channels = colors ? sizes[2] : 1;
    if ((sizes.size() != 2 && !colors) || (image.channels != 1 && image.channels != 3)) {
      throw py::value_error("frame must have shape (H, W), (H, W, 1) or (H, W, 3), got " +
                            shown(sizes));
    }
    if (sizes[0] != height || sizes[1] != width) {
      throw py::value_error("frame must be of the plan's size, (H, W) = " + shown({height, width}) +
                            ", got " + shown({sizes[0], sizes[1]}));
    }
    if (scale.size() > 1 && image.channels != static_cast<int64_t>(scale.size())) {
      throw py::value_error("frame must have the plan's " + std::to_string(scale.size()) +
                            " channels, got " + std::to_string(image.channels));
    }
    image.pixels = static_cast<const uint8_t*>(frame.data());
    image.height = height, image.width = width;
    // The stride of an axis of size 1 may be any number, and is never used.
    const auto stride = [&](int axis) { return sizes[axis] > 1 ? frame.strides(axis) : 0; };
    image.row_stride = stride(0), image.column_stride = stride(1),
    image.channel_stride = colors ? stride(2) : 0;
    if ((height - 1) * std::abs(static_cast<double>(image.row_stride)) +
            (width - 1) * std::abs(static_cast<double>(image.column_stride)) >=
        INT32_MAX) {
      throw py::value_error("frame must span less than 2 GB of memory");
    }
    float factors[3] = {1, 1, 1}, shifts[3] = {};  // bytes are not normalized
    for (int c = 0; c < 3 && kind != FrameOutput::bytes; ++c) {
      factors[c] = scale[scale.size() > 1 ? c : 0], shifts[c] = offset[scale.size() > 1 ? c : 0];
    }
    image.scale = factors, image.offset = shifts;
    a.columns = columns.data(), a.rows = rows.data();
    a.right = right.data(), a.lower = lower.data();
    a.points = static_cast<int64_t>(columns.size()) - kFrameSpare;
    const int64_t pictures = kind != FrameOutput::tokens && shape.size() == 3 ? shape[0] : 1;
    a.reads = reads, a.pixels = a.points / reads / std::max<int64_t>(pictures, 1);
    a.border = border.data(), a.border_points = static_cast<int64_t>(border.size());
    a.output = kind;
    py::array result = output_array(out, output_shape(image.channels, colors));
    if (!out.is_none() && share_memory(frame, result)) {
      throw py::value_error("out must not share memory with the frame");
    }
    a.out = result.mutable_data();
    {
      const py::gil_scoped_release free;
      run(a, threads);
    }
    return result;
  }

 private:
  Shape output_shape(int64_t channels, bool colors) const {
    if (kind == FrameOutput::tokens) {
      return {shape[0], shape[1], shape[2] * shape[3] * channels};
    }
    Shape sizes = shape;
    if (kind == FrameOutput::planes) sizes.insert(sizes.end() - 2, channels);
    if (kind == FrameOutput::bytes && colors) sizes.push_back(channels);
    return sizes;
  }

  py::array output_array(const py::object& given, const Shape& sizes) const {
    const bool bytes = kind == FrameOutput::bytes;
    const py::dtype type = bytes ? py::dtype::of<uint8_t>() : py::dtype::of<float>();
    if (given.is_none()) return py::array(type, sizes);
    if (!py::isinstance<py::array>(given)) {
      throw py::type_error("out must be a NumPy array, got " +
                           std::string(py::str(py::type::of(given))));
    }
    const auto out = py::reinterpret_borrow<py::array>(given);
    const bool same =
        bytes ? py::isinstance<py::array_t<uint8_t>>(out) : py::isinstance<py::array_t<float>>(out);
    if (!same || !(out.flags() & py::array::c_style) || !out.writeable() ||
        Shape(out.shape(), out.shape() + out.ndim()) != sizes) {
      throw py::value_error("out must be a writeable, C-contiguous array of " +
                            std::string(bytes ? "uint8" : "float32") + " with shape " +
                            shown(sizes));
    }
    return out;
  }

  static void run(const FrameArgs& a, int64_t threads) {
    constexpr double kPerMicrosecond = 500;  // points
    const ThreadLimit limit(threads);
    const auto& kernel = kernels<FrameKernels>();
    parallel_ranges(
        a.points / a.reads, threads_for(a.points / kPerMicrosecond),
        [&](int64_t begin, int64_t end) { kernel.sample(a, begin * a.reads, end * a.reads); });
  }

  const int64_t reads;
  const Shape shape;
  std::vector<int16_t> columns, rows;
  const std::vector<float> right, lower;
  const int64_t height, width;
  const std::vector<float> scale, offset;
  FrameOutput kind;
  std::vector<BorderPoint> border;
};

// Finds the places of the points of one polar grid among the pixels of images of one size.
py::tuple polar_places(const Array<float>& radii, const Array<float>& azimuths,
                       const Array<float>& center, const std::optional<Array<float>>& affine,
                       const std::optional<Array<float>>& offsets,
                       std::pair<int64_t, int64_t> size) {
  const py::ssize_t count = radii.size(), around = azimuths.size();
  if (center.size() != 2 || (affine && affine->size() != 4) ||
      (offsets && offsets->size() != 2 * count * around)) {
    throw py::value_error("the arrays of the grid do not fit together");
  }
  PolarSampleArgs<float> a{};
  a.height = size.first, a.width = size.second;
  a.radii = radii.data(), a.num_radii = count, a.num_azimuths = around;
  a.center = center.data();
  if (affine) a.affine = affine->data();
  if (offsets) a.offsets = offsets->data(), a.offsets_end = a.offsets + offsets->size();
  const int64_t padded = (around + 15) / 8 * 8;
  std::vector<double> angles(3 * padded);
  std::copy_n(azimuths.data(), around, angles.begin());
  py::array_t<int16_t> columns({count, around}), rows({count, around});
  py::array_t<float> right({count, around}), lower({count, around});
  kernels<FrameKernels>().places(a, angles.data(), padded, columns.mutable_data(),
                                 rows.mutable_data(), right.mutable_data(), lower.mutable_data());
  return py::make_tuple(columns, rows, right, lower);
}

}  // namespace
}  // namespace darswin

PYBIND11_MODULE(_frames, m) {
  using namespace darswin;
  m.doc() = "The compiled part of darswin.frames.";
  // A function: of a class, __new__ would make objects whose memory nothing has filled.
  m.def("sampler", [](const Array<int16_t>& columns, const Array<int16_t>& rows,
                      const Array<float>& right, const Array<float>& lower,
                      std::pair<int64_t, int64_t> size, std::vector<float> scale,
                      std::vector<float> offset, const std::string& output, int64_t reads) {
    const auto sampler = std::make_shared<const Sampler>(
        columns, rows, right, lower, size, std::move(scale), std::move(offset), output, reads);
    return py::cpp_function([sampler](const py::object& frame, const py::object& out,
                                      int64_t threads) { return (*sampler)(frame, out, threads); },
                            py::name("sample"), py::arg("frame"), py::arg("out") = py::none(),
                            py::arg("threads") = 1);
  });
  m.def("polar_places", &polar_places);
}
