// Reads the arrays and the texts of a file in the layout of safetensors, as
// darswin/frames/tensor_file.py writes it. docs/reference/files.md describes it byte by byte.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <span>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace darswin {

// A whole file, checked. Its arrays stay in the file, which is mapped: replace a file that is in
// use, and do not write into it. What is wrong is a std::invalid_argument, or a std::system_error
// if the system cannot read the file. Nothing that the file claims is trusted, even if its checksum
// is right.
class TensorFile {
 public:
  struct Tensor {
    std::string type;  // such as "F32"
    std::vector<int64_t> shape;
    int64_t count;  // of its numbers
    const char* data;
  };

  explicit TensorFile(const std::string& path);

  // The array of this name and type, flat, in C order.
  template <typename T>
  std::span<const T> numbers(std::string_view name) const {
    const Tensor& found = tensor(name, type_of<T>);
    return {reinterpret_cast<const T*>(found.data), static_cast<size_t>(found.count)};
  }
  // An array that must have one number.
  template <typename T>
  T number(std::string_view name) const {
    const auto found = numbers<T>(name);
    if (found.size() != 1) wrong(name, "must be one number");
    return found[0];
  }
  const std::vector<int64_t>& shape(std::string_view name) const;
  // The text of this name in UTF-8, or null.
  const std::string* find_text(std::string_view name) const;
  const std::string& text(std::string_view name) const;

  std::map<std::string, Tensor, std::less<>> tensors;
  std::map<std::string, std::string, std::less<>> texts;

 private:
  [[noreturn]] static void wrong(std::string_view name, const std::string& what);
  const Tensor& tensor(std::string_view name) const;
  const Tensor& tensor(std::string_view name, std::string_view type) const;
  template <typename T>
  static constexpr std::string_view type_of = "";

  std::shared_ptr<const char> content;
};

template <>
inline constexpr std::string_view TensorFile::type_of<int64_t> = "I64";
template <>
inline constexpr std::string_view TensorFile::type_of<int32_t> = "I32";
template <>
inline constexpr std::string_view TensorFile::type_of<int16_t> = "I16";
template <>
inline constexpr std::string_view TensorFile::type_of<float> = "F32";
template <>
inline constexpr std::string_view TensorFile::type_of<double> = "F64";

}  // namespace darswin
